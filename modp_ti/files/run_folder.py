"""The output folder of a run: its files appear together, and nothing is replaced or removed that no run has written.

The subfolder `.modp-ti` holds `files.json`, the list of what runs have written to the folder, and temporary files.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path, PurePosixPath

from modp_ti.files.atomic import replace_text, sync_folder
from modp_ti.files.errors import InputError
from modp_ti.files.reading import read_json, reading

PRIVATE = ".modp-ti"
"""Name of the subfolder of the list and of temporary files."""

LIST = "files.json"
# Moved last and removed first, so that a folder that has it is complete.
LAST = "metrics.json"
# What a run may write to its folder.
OF_A_RUN = (
    "config.yaml splats.ply trajectory.txt frames.json exposure.json metrics.json scores.csv report.html session.zip "
    "snapshot.npz recording.yaml colmap masks renders sfm"
).split()
# A folder without a list whose config.yaml begins like this is a copy: these files are listed.
SETTINGS = b"# Every setting of this run: "
RECOGNISED = re.compile(
    rf"{'|'.join(map(re.escape, OF_A_RUN))}|(renders|masks)/[0-9]+\.png|colmap/(images|masks)/.+\.png|sfm/made_of\.txt"
    r"|(colmap|sfm)/(cameras|images|points3D|rigs|frames)\.bin"
)
# What file managers put into folders. It is left alone.
OF_THE_SYSTEM = re.compile(r"\..*|Thumbs\.db|desktop\.ini", re.IGNORECASE)
# Time that a run waits for another process to end [s].
PATIENCE = 2.0
# The folders that this process holds: the thread that locked each, and its device and inode.
_held: set[tuple[int, int, int]] = set()


@dataclass(frozen=True)
class _Record:
    """Content of `files.json`.

    Attributes:
        files: What runs have written, relative to the folder.
        staged: Temporary folder whose files are being moved to their places, while those of `gone` are removed.
        gone: Files of an earlier run.
    """

    files: frozenset[str] = frozenset()
    staged: str = ""
    gone: frozenset[str] = frozenset()


@contextmanager
def run_folder(output: Path, adopted: Collection[str] = ()) -> Iterator[None]:
    """Create and lock the output folder of a run, which is removed again if the run leaves nothing there.

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
            staged = Path(tempfile.mkdtemp(prefix="new-", dir=output / PRIVATE))
            try:
                yield staged
                _commit(output, staged, outdated)
            finally:
                if not _record(output).staged:  # otherwise, the move has begun, and is completed later
                    shutil.rmtree(staged, ignore_errors=True)
                with suppress(OSError):
                    (output / PRIVATE).rmdir()
    except OSError as error:
        raise InputError(f"{output}: cannot be written: {error.strerror}") from None


def list_files(output: Path, names: Collection[str]) -> None:
    """Add files that are in a folder to its list. Raises OSError if it cannot be written."""
    with sole_use(output):
        record = _record(output)
        _write(output, _Record(record.files.union(names), record.staged, record.gone))


def refuse_foreign(output: Path, names: Iterable[str]) -> None:
    """Raise InputError if there is something of these names in a folder that no run has written."""
    own = _record(output).files
    for name in names:
        for place in (output / part for part in PurePosixPath(name).parents[:-1]):
            if os.path.islink(place) or os.path.isfile(place):
                raise _foreign(place)
        for file in _files(output / name):
            inside = file.relative_to(output).as_posix()
            if inside not in own and (inside == name or not OF_THE_SYSTEM.fullmatch(file.name)):
                raise _foreign(file)


def require_usable(output: Path, adopted: Collection[str] = ()) -> None:
    """Raise InputError unless a run can write all its files to a folder, which need not exist. Nothing is left there.

    Args:
        output: The folder.
        adopted: As for `run_folder`.
    """
    there = next(place for place in (output, *output.absolute().parents) if os.path.lexists(place))
    if there == output and not os.path.isdir(output):
        raise InputError(f"{output}: output must be a folder, this is a file")
    refuse_foreign(output, [name for name in OF_A_RUN if name not in adopted])
    try:
        with tempfile.TemporaryDirectory(prefix=".modp-ti-", dir=there) as folder:
            (Path(folder) / "test").write_bytes(bytes(4096))
    except OSError as error:
        raise InputError(f"{output}: cannot be written: {error.strerror}; name another folder (output)") from None


def require_whole(output: Path) -> None:
    """Complete the move of files that a killed process has left half done. Every reader of a run's files calls it.

    Raises:
        InputError: If it cannot be completed, or another process is moving them.
    """
    if not _record(output).staged:
        return
    try:
        with sole_use(output, PATIENCE):
            if (record := _record(output)).staged:
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
    """Move the files of `staged` to the output folder, if they replace nothing but files of a run."""
    record = _record(output)
    new = {file.relative_to(staged).as_posix() for file in _files(staged)}
    below = tuple(f"{name}/" for name in outdated)
    gone = {name for name in record.files - new if name in outdated or name.startswith(below)}
    refuse_foreign(output, new | gone)
    if not new and not gone:
        return
    if len(new) + len(gone) > 1 or not new <= record.files or not os.path.isfile(output / PRIVATE / LIST):
        record = _Record(record.files | new, staged.name, frozenset(gone))
        _write(output, record)
    _move(output, _Record(record.files, staged.name, frozenset(gone)))


def _move(output: Path, record: _Record) -> None:
    """Do what a record says. It may have been done in part already."""
    staged = output / PRIVATE / record.staged
    files = sorted(_files(staged), key=lambda file: (file.name == LAST, file))
    refuse_foreign(output, [*record.gone, *(file.relative_to(staged).as_posix() for file in files)])
    for name in sorted(record.gone, key=lambda name: (name != LAST, name)):
        (output / name).unlink(missing_ok=True)
        with suppress(OSError):  # those that still hold something stay
            for folder in PurePosixPath(name).parents[:-1]:
                (output / folder).rmdir()
    for file in files:
        target = output / file.relative_to(staged)
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.is_dir() and not target.is_symlink():
            target.rmdir()  # an empty one
        os.replace(file, target)
    sync_folder(output)
    if record.gone or _record(output).staged:
        _write(output, _Record(record.files - record.gone))


def _private(output: Path) -> Path:
    """Return the private subfolder. Raises InputError if something else is in its place."""
    private = output / PRIVATE
    if os.path.islink(private) or os.path.isfile(private):
        raise _foreign(private)
    return private


def _record(output: Path) -> _Record:
    """Read the list of a folder, or make that of a folder without one. Raises InputError if it is damaged."""
    file = _private(output) / LIST
    if not os.path.lexists(file):
        with suppress(OSError):
            if (output / "config.yaml").read_bytes().startswith(SETTINGS):  # a copy without the list
                names = [each.relative_to(output).as_posix() for each in _files(output)]
                return _Record(frozenset(filter(RECOGNISED.fullmatch, names)))
        return _Record()
    data = read_json(file, "of runs")
    with reading(file, "; remove it, or name another folder"):
        return _Record(frozenset(map(str, data["files"])), str(data["staged"]), frozenset(map(str, data["gone"])))


def _write(output: Path, record: _Record) -> None:
    content = {"files": sorted(record.files), "staged": record.staged, "gone": sorted(record.gone)}
    _private(output).mkdir(exist_ok=True)
    replace_text(output / PRIVATE / LIST, json.dumps(content, indent=1) + "\n")


def _files(place: Path) -> Iterator[Path]:
    """Yield a file, or the files of a folder and its subfolders. A symbolic link is a file."""
    if os.path.lexists(place) and (os.path.islink(place) or not os.path.isdir(place)):
        yield place
        return
    for folder, subfolders, files in os.walk(place):
        links = [name for name in subfolders if os.path.islink(os.path.join(folder, name))]
        yield from (Path(folder) / name for name in (*files, *links))


def _foreign(path: Path) -> InputError:
    return InputError(f"{path}: is there already, and no run has written it: move it, or name another folder (output)")


# ---- one process at a time -----------------------------------------------------------------------------------------


@contextmanager
def sole_use(folder: Path, patience: float = 20.0) -> Iterator[None]:
    """Lock a folder, which is created if it does not exist, for this thread. The lock ends with the process.

    A thread may lock a folder that it has locked already. Folders that were created for it and are still empty at the
    end are removed.

    File systems that have no locks for folders, such as some network file systems, lock nothing, and neither does
    Windows.

    Args:
        folder: The folder.
        patience: How long to wait for another process to end [s].

    Raises:
        InputError: If another process still holds the lock, or the folder cannot be created.
    """
    folder = folder.absolute()
    missing = list(takewhile(lambda place: not os.path.lexists(place), (folder, *folder.parents)))
    until = time.monotonic() + patience
    while (handle := _locked(folder)) is None:
        if time.monotonic() > until:
            raise InputError(f"{folder}: another process is at work there: wait for it, end it, or name another folder")
        time.sleep(0.1)
    holder = _holder(handle)
    again = holder in _held
    _held.add(holder)
    try:
        yield
    finally:
        if not again:
            _held.discard(holder)
        with suppress(OSError):  # one that holds something stays, and so do its parents
            for place in missing:
                place.rmdir()
        os.close(handle)


def _holder(handle: int) -> tuple[int, int, int]:
    there = os.fstat(handle)
    return threading.get_ident(), there.st_dev, there.st_ino


def _locked(folder: Path) -> int | None:
    """Make, open and lock a folder without waiting; return None if another process holds the lock."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(os.devnull if sys.platform == "win32" else folder, os.O_RDONLY)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None
    if sys.platform == "win32" or _holder(handle) in _held:
        return handle
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        return None
    except OSError:  # not on this file system
        return handle
    with suppress(FileNotFoundError):
        if os.path.samestat(os.fstat(handle), os.stat(folder)):
            return handle
    os.close(handle)  # of a folder that the process that held it has removed
    return None
