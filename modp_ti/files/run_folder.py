"""The output folder of a run: its files appear together, and nothing is replaced or removed that no run has written.

The subfolder `.modp-ti` holds `files.json`, the list of what runs have written to the folder, and temporary files.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath

from modp_ti.files.atomic import replace_text, sync_folder
from modp_ti.files.errors import InputError
from modp_ti.files.json_text import read_json
from modp_ti.files.sole_use import sole_use

__all__ = [
    "PRIVATE",
    "SETTINGS_HEADER",
    "appearing",
    "is_run_folder",
    "list_files",
    "refuse_foreign",
    "require_usable",
    "require_whole",
    "run_folder",
]

PRIVATE = ".modp-ti"
"""Name of the subfolder of the list and of temporary files."""

SETTINGS_HEADER = "# Every setting of this run: `modp-ti run` on this file gives the same map.\n"
"""First line of `config.yaml`, by which a folder without a list is known to be of an earlier version or a copy."""

LIST = "files.json"
# What a run may write to its folder.
OF_A_RUN = (
    "config.yaml splats.ply trajectory.txt frames.json exposure.json metrics.json scores.csv report.html session.zip "
    "snapshot.npz colmap masks renders sfm"
).split()
# Moved last and removed first, so that a folder that has it is complete.
LAST = "metrics.json"
# What a run writes, for folders without a list.
WRITTEN = re.compile(
    r"(config\.yaml|splats\.ply|trajectory\.txt|frames\.json|exposure\.json|metrics\.json|scores\.csv|report\.html"
    r"|session\.zip|snapshot\.npz|(renders|masks)/[0-9]+\.png|(colmap|sfm)/(cameras|images|points3D|rigs|frames)\.bin"
    r"|sfm/made_of\.txt|colmap/(images|masks)/.+\.png)"
)
# What file managers put into folders. It is left alone.
OF_THE_SYSTEM = re.compile(r"\..*|Thumbs\.db|desktop\.ini", re.IGNORECASE)
# Time that a run waits for another process to end [s].
PATIENCE = 2.0


@dataclass(frozen=True)
class _Record:
    """Content of `files.json`.

    Attributes:
        files: What runs have written, relative to the folder.
        staged: Name of the temporary folder whose files are being moved to their places; empty for none.
        gone: Files that are removed with this move.
    """

    files: frozenset[str] = frozenset()
    staged: str = ""
    gone: frozenset[str] = frozenset()


@contextmanager
def run_folder(output: Path, adopted: Collection[str] = ()) -> Iterator[None]:
    """Lock the output folder of a run, and check that all that the run will write can be written there.

    The folder is created. If the run leaves nothing there, it is removed again.

    Args:
        output: The folder.
        adopted: Files in it that are those of a run, whatever the list says.

    Raises:
        InputError: If another process works there; or as `require_usable`.
    """
    require_usable(output, adopted)
    with sole_use(output, PATIENCE):
        require_whole(output)
        require_usable(output, adopted)
        for left in (output / PRIVATE).glob("*"):  # by a process that was killed
            if left.name != LIST:
                shutil.rmtree(left) if left.is_dir() and not left.is_symlink() else left.unlink()
        if adopted:
            list_files(output, adopted)
        try:
            yield
        finally:
            with suppress(OSError):
                (output / PRIVATE).rmdir()


@contextmanager
def appearing(output: Path, outdated: Collection[str] = ()) -> Iterator[Path]:
    """Yield an empty temporary folder whose files move to `output` on exit, all or none of them.

    A process that is killed while they move leaves a folder that `require_whole` completes.

    Args:
        output: The folder. It is created if it does not exist.
        outdated: Names of files and folders in it. What a run has written there goes if it is not replaced.

    Raises:
        InputError: If the files cannot be written, or would replace something that no run has written.
    """
    try:
        with sole_use(output):
            require_whole(output)
            _private(output).mkdir(exist_ok=True)
            staged = Path(tempfile.mkdtemp(prefix="new-", dir=_private(output)))
            try:
                yield staged
                _commit(output, staged, outdated)
            finally:
                # Left where the move has begun: it is completed later.
                if not _record(output).staged:
                    shutil.rmtree(staged, ignore_errors=True)
                with suppress(OSError):
                    _private(output).rmdir()
    except OSError as error:
        raise InputError(f"{output}: cannot be written: {error.strerror}") from None


def list_files(output: Path, names: Collection[str]) -> None:
    """Add files to the list that are written to their places at once or are there already.

    Raises:
        InputError: If the list cannot be written.
    """
    try:
        with sole_use(output):
            _private(output).mkdir(exist_ok=True)
            record = _record(output)
            if not record.files.issuperset(names):
                _write(output, _Record(record.files | set(names), record.staged, record.gone))
    except OSError as error:
        raise InputError(f"{output}: cannot be written: {error.strerror}") from None


def refuse_foreign(output: Path, names: Iterable[str]) -> None:
    """Raise InputError if there is something of these names in a folder that no run has written."""
    own = _record(output).files
    for name in names:
        for file in _files(output / name):
            inside = file.relative_to(output).as_posix()
            if inside not in own and (inside == name or not OF_THE_SYSTEM.fullmatch(file.name)):
                raise InputError(_foreign(file))


def require_usable(output: Path, adopted: Collection[str] = ()) -> None:
    """Raise InputError unless a run can write all its files to a folder, which need not exist. Nothing is left there.

    Args:
        output: The folder.
        adopted: Files in it that are those of a run, whatever the list says.
    """
    if os.path.lexists(output) and not os.path.isdir(output):
        raise InputError(f"{output}: output must be a folder, this is a file")
    refuse_foreign(output, [name for name in OF_A_RUN if name not in adopted])
    there = next(place for place in (output, *output.absolute().parents) if os.path.lexists(place))
    try:
        with tempfile.TemporaryDirectory(prefix=".modp-ti-", dir=there) as folder:
            (Path(folder) / "test").write_bytes(bytes(4096))
    except OSError as error:
        raise InputError(f"{output}: cannot be written: {error.strerror}; name another folder (output)") from None


def require_whole(output: Path) -> None:
    """Complete the move of files to their places that a killed process has left half done.

    Raises:
        InputError: If it cannot be completed, or another process is moving them.
    """
    if not _record(output).staged:
        return
    try:
        with sole_use(output, PATIENCE):
            record = _record(output)
            if record.staged:
                _move(output, record)
    except OSError as error:
        raise InputError(f"{output}: a run has ended while it moved its files here: {error.strerror}") from None
    except InputError:
        if _record(output).staged:
            raise


def is_run_folder(folder: Path) -> bool:
    """Whether a run has written files to a folder."""
    return bool(_record(folder).files)


def _commit(output: Path, staged: Path, outdated: Collection[str]) -> None:
    """Move the files of `staged` to the output folder."""
    record = _record(output)
    new = {file.relative_to(staged).as_posix() for file in _files(staged)}
    below = tuple(f"{name}/" for name in outdated)
    gone = {name for name in record.files - new if name in outdated or name.startswith(below)}
    for name in sorted(new | gone):
        places = [output / part for part in reversed(PurePosixPath(name).parents[:-1])]
        for place in places:
            if os.path.lexists(place) and (place.is_symlink() or not place.is_dir()):
                raise InputError(_foreign(place))
        target = output / name
        if os.path.lexists(target) and (name not in record.files or (target.is_dir() and not target.is_symlink())):
            raise InputError(_foreign(target))
    if not new and not gone:
        return
    after = _Record(record.files | new, staged.name if len(new) + len(gone) > 1 else "", frozenset(gone))
    if after.staged or not new <= record.files or not os.path.exists(_private(output) / LIST):
        _write(output, after)
    _move(output, _Record(after.files, staged.name, after.gone))


def _move(output: Path, record: _Record) -> None:
    """Do what a record says, and note that it is done. It may have been done in part already."""
    staged = _private(output) / record.staged
    for name in sorted(record.gone, key=lambda name: (name != LAST, name)):
        (output / name).unlink(missing_ok=True)
        with suppress(OSError):  # those that still hold something stay
            for place in PurePosixPath(name).parents[:-1]:
                (output / place).rmdir()
    for file in sorted(_files(staged), key=lambda file: (file.name == LAST, file)):
        target = output / file.relative_to(staged)
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, target)
    sync_folder(output)
    if record.gone or _record(output).staged:
        _write(output, _Record(record.files - record.gone))


def _private(output: Path) -> Path:
    """Return the private subfolder. Raises InputError if something else is in its place."""
    private = output / PRIVATE
    if os.path.islink(private) or os.path.isfile(private):
        raise InputError(_foreign(private))
    return private


def _record(output: Path) -> _Record:
    """Read the list of a folder, or make that of a folder without one. Raises InputError if it is damaged."""
    file = _private(output) / LIST
    if not os.path.lexists(file):
        return _Record(_recognised(output))
    data = read_json(file, "the list of the files that runs have written")
    damaged = InputError(f"{file}: damaged: remove it, or name another folder (output)")
    try:
        record = _Record(frozenset(data["files"]), data["staged"], frozenset(data["gone"]))
    except (TypeError, KeyError):
        raise damaged from None
    if not all(map(_is_inside, record.files | record.gone)) or (record.staged != "" and not _is_inside(record.staged)):
        raise damaged
    return record


def _is_inside(name: object) -> bool:
    """Whether a name from a list is that of a file below the folder, and none of the private ones."""
    parts = name.split("/") if isinstance(name, str) else [""]
    return not {"", ".", ".."}.intersection(parts) and parts[0] != PRIVATE and "\0" not in str(name)


def _recognised(output: Path) -> frozenset[str]:
    """Return the files of a run in a folder without a list, which an earlier version or a copy has left."""
    try:
        with (output / "config.yaml").open("rb") as file:
            if file.readline(200).decode() != SETTINGS_HEADER:
                return frozenset()
    except (OSError, UnicodeDecodeError):
        return frozenset()
    names = (file.relative_to(output).as_posix() for file in _files(output))
    return frozenset(name for name in names if WRITTEN.fullmatch(name))


def _write(output: Path, record: _Record) -> None:
    content = {name: sorted(value) if isinstance(value, frozenset) else value for name, value in asdict(record).items()}
    replace_text(_private(output) / LIST, json.dumps(content, indent=1) + "\n")


def _files(place: Path) -> Iterator[Path]:
    """Yield a file, or the files of a folder and its subfolders. A symbolic link is a file."""
    if os.path.isfile(place) or os.path.islink(place):
        yield place
    for folder, subfolders, files in os.walk(place) if not os.path.islink(place) else ():
        links = [name for name in subfolders if os.path.islink(os.path.join(folder, name))]
        yield from (Path(folder) / name for name in (*files, *links))


def _foreign(path: Path) -> str:
    return f"{path}: is there already, and no run has written it: move it, or name another folder (output)"
