"""Every file of the corpus is taken, or refused with an InputError: what the fuzzer found, and what hands have damaged.

The corpus is `corpus.tar.xz`, whose members are called KIND/FILE/HASH: the content of one file of a sample of that kind
(`tests/samples/kinds.py`), with `|` for `/` in the file's name.
"""

from __future__ import annotations

import io
import tarfile
import warnings
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from threading import Thread

import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_tracker
from tests.modp_ti.inputs.tracker_server.clients import END, FRAME, HELLO, connect, frame, hello, message, opened
from tests.samples.kinds import SAMPLES, write_sample

ARCHIVE = Path(__file__).with_name("corpus.tar.xz")
ALONE = {"weights": ("weights.pth", "older.pth"), "tracker_server": ("wire",)}
"""Files of kinds that have no sample."""
FILES = {kind: sample.files for kind, sample in SAMPLES.items()} | ALONE

Content = tuple[str, bytes]  # the file's name in the sample's folder, and its content


def corpus() -> dict[str, list[Content]]:
    """Return the corpus by kind."""
    found: dict[str, list[Content]] = {kind: [] for kind in FILES}
    with tarfile.open(ARCHIVE) as archive:
        for member in archive:
            kind, file, _ = member.name.split("/")
            content = archive.extractfile(member)
            assert content is not None
            found.setdefault(kind, []).append((file.replace("|", "/"), content.read()))
    return found


def add_to_corpus(kind: str, contents: Iterable[tuple[str, str, bytes]]) -> None:
    """Add files, as (file, hash, content), to the corpus."""
    with tarfile.open(ARCHIVE) as archive:
        members = {each.name: archive.extractfile(each).read() for each in archive}
    members |= {f"{kind}/{file.replace('/', '|')}/{name}": data for file, name, data in contents}
    with tarfile.open(ARCHIVE, "w:xz", preset=9) as archive:
        for name, data in sorted(members.items()):
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))


def is_taken(kind: str, folder: Path, content: Content) -> bool:
    """Read a file in place of that of the sample in `folder`, and return whether it was accepted."""
    file = folder / content[0]
    before = file.read_bytes() if file.exists() else b""
    file.write_bytes(content[1])
    try:
        _read(kind, file, folder)
    except InputError:
        return False
    finally:
        file.write_bytes(before)
    return True


def _read(kind: str, file: Path, folder: Path) -> None:
    if kind == "weights":
        from pipelines.torch_checkpoint import read_checkpoint

        try:
            read_checkpoint(file)
        except ValueError as error:
            raise InputError(str(error)) from None
    elif kind == "tracker_server":
        _converse(folder / "socket", file.read_bytes())
    elif kind == "run":
        _read_run(file, folder / "out")
    else:
        tracker = open_tracker(load_scene(folder / "scene.yaml"))
        try:
            for _ in tracker:
                pass
        finally:
            tracker.close()


def _converse(path: Path, data: bytes) -> None:
    """Send what a tracker says, and take in all frames that come of it.

    A bad start is dropped, and the server waits for the next tracker: one that behaves follows.
    """
    behaves = message(HELLO, hello()) + message(FRAME, frame(1)) + message(FRAME, frame(2)) + message(END)

    def say() -> None:
        for content in (data, behaves):
            with suppress(OSError), connect(path) as connection:  # nobody listens after a whole conversation
                connection.sendall(content)

    with opened(path) as tracker:
        thread = Thread(target=say)
        thread.start()
        try:
            for _ in tracker:
                pass
        finally:
            thread.join()


def _read_run(file: Path, out: Path) -> None:
    from modp_ti.outputs.formats.run_files import read_exposures, read_masks, read_scores
    from modp_ti.outputs.playback.finished_run import open_run

    if file.name == "exposure.json":
        read_exposures(file)
    elif file.name == "scores.csv":
        read_scores(file)
    elif file.parent.name == "masks":
        read_masks(file.parent)
    else:
        open_run(out)


@pytest.mark.parametrize("kind", FILES)
def test_the_corpus_of_a_kind_does_no_harm(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "sample"
    folder.mkdir() if kind in ALONE else write_sample(kind, folder)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        for content in corpus()[kind]:
            is_taken(kind, folder, content)


def test_the_corpus_is_of_kinds_and_files_that_there_are() -> None:
    strange = {(kind, file) for kind, contents in corpus().items() for file, _ in contents if kind not in FILES}
    assert not strange, "take them out of the corpus"
