"""Snapshots: what is read back is what the run has kept; anything else is refused in one line; copies that fail."""

from __future__ import annotations

import errno
import io
import os
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fields.map.trajectory import Trajectory
from fields.runtime.backend import initialise
from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.engine import snapshot as module
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.results import RunClock
from modp_ti.engine.resume import fetch_snapshot, load_resumed, replay
from modp_ti.engine.snapshot import FILE, Checkpointer, Position, Snapshot, StreamDigest
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import PRIVATE, list_files
from modp_ti.files.storage import Storage, StorageError
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.outputs.report.record import RunRecord
from modp_ti.version import __version__
from tests.pipelines.test_online import SETTINGS
from tests.pipelines.wall import frame

ARRAYS = {
    "gaussians.position": np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32),
    "voxels.words": np.array([1, 1 << 63], dtype=np.uint64),
    "frames.held_out": np.array([True, False]),
    "previous.index": np.array(7),
    "online.sh": np.zeros((0, 4, 3), dtype=np.float32),
}
NUMBERS = {"random": {"state": 2**127 + 5}, "rate": 0.1}
FRAMES = 3
SCENE = "source: {path: images, scale: 1}\ntracker: {kind: colmap}\noutput: out\nsnapshot_every: 2\n"


def config(folder: Path, **settings: str) -> SceneConfig:
    (folder / "scene.yaml").write_text(SCENE + "".join(f"{key}: {value}\n" for key, value in settings.items()))
    return load_scene(folder / "scene.yaml")


# ---- the file ----------------------------------------------------------------------------------------------------


@pytest.fixture
def path(tmp_path: Path) -> Path:
    Snapshot(tmp_path / FILE, {"seed": 3}, Position(7, 2**32 - 1, True, 9), ARRAYS, NUMBERS).write(tmp_path / FILE)
    return tmp_path / FILE


def assert_refused(file: Path, *said: str) -> None:
    with pytest.raises(InputError) as refused:
        Snapshot.read(file)
    assert all(text in str(refused.value) for text in (str(file), *said)) and "\n" not in str(refused.value)


def test_what_is_written_is_read_back_to_the_bit(path: Path) -> None:
    found = Snapshot.read(path)
    assert (found.settings, found.numbers, found.program) == ({"seed": 3}, NUMBERS, __version__)
    assert found.position == Position(7, 2**32 - 1, True, 9)
    assert list(found.arrays) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert found.arrays[name].dtype == array.dtype and found.arrays[name].shape == array.shape
        assert found.arrays[name].tobytes() == array.tobytes()
    found.arrays["gaussians.position"][0] = 1.0  # the run resumes in these arrays


def test_another_version_is_refused_with_its_number(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "VERSION", 5)
    Snapshot(path, {}, Position(0, 0), ARRAYS, NUMBERS).write(path)
    monkeypatch.undo()
    assert_refused(path, "5", f"{module.VERSION}", f"MODP-Ti {__version__}")


def test_one_that_is_cut_short_is_refused(path: Path) -> None:
    data = path.read_bytes()
    for share in (0.0, 0.1, 0.5, 0.9, 0.999):
        path.write_bytes(data[: int(share * len(data))])
        assert_refused(path)


def test_a_flipped_bit_is_noticed_or_harmless(path: Path) -> None:
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(100):
        data = bytearray(whole)
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        try:
            arrays = Snapshot.read(path).arrays
        except InputError as error:
            assert "\n" not in str(error)
        else:  # names of files and times stand in the archive twice
            assert all(arrays[name].tobytes() == array.tobytes() for name, array in ARRAYS.items() if name in arrays)


def stored(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def headed(shape: tuple[int, ...]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return stream.getvalue()


@pytest.mark.parametrize(
    "member",
    [
        headed((1 << 40, 1 << 20)),  # huge
        headed((5,)),  # shorter than it says
        stored(np.array([{"a": 1}], dtype=object)),  # what Python would run
        *(stored(np.frombuffer(text, dtype=np.uint8)) for text in (b"", b"[]", b"\xff")),
    ],
)
def test_an_archive_that_is_none_of_ours_is_refused(tmp_path: Path, member: bytes) -> None:
    with zipfile.ZipFile(tmp_path / FILE, "w") as out:
        out.writestr("about.npy", member)
    assert_refused(tmp_path / FILE)


# ---- a run that writes them --------------------------------------------------------------------------------------


class Run:
    """The wall of the mapping tests, mapped with a checkpointer next to it."""

    def __init__(self, folder: Path, **settings: str) -> None:
        self.mapper = Mapper(64, 48, SETTINGS, seed=5)
        self.record, self.said = RunRecord(), list[str]()
        self.checkpointer = Checkpointer(
            config(folder, **settings), self.mapper, self.record, RunClock(), self.said.append
        )
        self.record.begin()

    def take(self, i: int) -> None:
        event = frame(i, held_out=i == 1)
        self.checkpointer.digest.add(event)
        self.record.frame(i, self.mapper.add(event))
        self.checkpointer.after_frame()


@pytest.fixture
def run(tmp_path: Path) -> Run:
    initialise("cpu")
    run = Run(tmp_path)
    for i in range(FRAMES):
        run.take(i)
    return run


@pytest.mark.slow
def test_it_holds_what_the_run_has_kept(run: Run) -> None:
    assert run.checkpointer.written == 1  # after two frames of three
    assert run.checkpointer.keep() and run.checkpointer.written == 2
    assert run.checkpointer.keep() and run.checkpointer.written == 2  # nothing has happened since
    snapshot = Snapshot.read(run.checkpointer.path)
    assert snapshot.position.events == FRAMES
    trajectory = Trajectory()
    trajectory.restore(snapshot.map.group("tracked"))
    frames: DeliveredFrames = snapshot.frames(trajectory)
    of = run.mapper.frames
    for name in ("index", "name", "timestamp", "camera", "held_out", "corrections"):
        assert getattr(frames, name) == getattr(of, name)
    np.testing.assert_array_equal(frames.T_tracked, of.T_tracked)
    for name, array in of.points.state().items():
        np.testing.assert_array_equal(frames.points.state()[name], array)
    record = RunRecord()
    snapshot.record(record)
    assert (record.frames, record.steps, record.started) == (run.record.frames, [], run.record.started)


@pytest.mark.slow
def test_a_full_disk_keeps_the_snapshot_before_and_says_so_once(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    run.checkpointer.keep()
    before = run.checkpointer.path.read_bytes()

    def full(file, **arrays: object) -> None:
        file.write(before[:1000])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, "savez", full)
    failed = run.checkpointer.failed
    for i in (FRAMES, FRAMES + 1):
        run.take(i)
        assert not run.checkpointer.keep()
    assert run.checkpointer.failed > failed
    path = run.checkpointer.path
    (said,) = run.said
    assert str(path.parent) in said and os.strerror(errno.ENOSPC) in said
    assert path.read_bytes() == before and sorted(os.listdir(path.parent)) == [PRIVATE, FILE]
    monkeypatch.undo()
    assert run.checkpointer.keep()
    assert Snapshot.read(path).position.events == FRAMES + 2


@pytest.mark.slow
def test_another_input_is_refused(run: Run) -> None:
    assert run.checkpointer.keep()
    snapshot = Snapshot.read(run.checkpointer.path)
    events = [frame(i, held_out=i == 1) for i in range(FRAMES)]
    image = events[0].image.copy()
    image[3, 4] = 0.0
    for others in (events[:-1], [replace(events[0], image=image), *events[1:]]):
        initialise("cpu")
        with pytest.raises(InputError, match="the input differs"):
            replay(snapshot, Mapper(64, 48, SETTINGS), iter(others), StreamDigest())


@pytest.mark.slow
def test_a_storage_that_fails_is_reported_once_and_left_alone_after_the_second_time(tmp_path: Path) -> None:
    initialise("cpu")
    (tmp_path / "file").touch()
    run = Run(tmp_path, snapshot_store=f"file://{tmp_path}/file/store")
    for i in range(4):
        run.take(i)
    (line,) = run.said
    assert "Not a directory" in line
    (tmp_path / "file").unlink()
    for i in range(4, 6):
        run.take(i)
    assert not (tmp_path / "file").exists() and run.checkpointer.written == 3


# ---- copies ------------------------------------------------------------------------------------------------------


@pytest.fixture
def stored_config(tmp_path: Path) -> SceneConfig:
    return config(tmp_path, snapshot_store=f"file://{tmp_path}/store")


def snapshot(file: Path, config: SceneConfig, events: int, refined: int = 0) -> Path:
    """A snapshot file of which nothing but its place in the run and its settings is real."""
    file.parent.mkdir(parents=True, exist_ok=True)
    position = Position(events, 5, refined > 0, refined)
    Snapshot(file, config.model_dump(mode="json"), position, {"a": np.zeros(1)}, {}).write(file)
    return file


def put(file: Path, config: SceneConfig) -> None:
    assert config.snapshot_store is not None
    Storage(config.snapshot_store).put(file, FILE)


def place(file: Path) -> tuple[int, int]:
    position = Snapshot.read(file).position
    return position.events, position.refined


@pytest.mark.parametrize(
    ("here", "there", "expected"),
    [
        (None, (4, 0), (4, 0)),
        ((2, 0), (4, 0), (4, 0)),
        ((4, 0), (2, 0), (4, 0)),
        ((4, 9), (4, 0), (4, 9)),
        ((4, 0), (4, 9), (4, 9)),
        ((4, 0), None, (4, 0)),
    ],
)
def test_the_snapshot_that_is_further_is_taken(
    tmp_path: Path,
    stored_config: SceneConfig,
    here: tuple[int, int] | None,
    there: tuple[int, int] | None,
    expected: tuple[int, int],
) -> None:
    if there is not None:
        put(snapshot(tmp_path / "other" / FILE, stored_config, *there), stored_config)
    if here is not None:
        snapshot(stored_config.output / FILE, stored_config, *here)
        list_files(stored_config.output, [FILE])
    fetch_snapshot(stored_config)
    assert place(stored_config.output / FILE) == expected


def test_a_copy_that_is_damaged_or_of_other_settings_does_not_take_the_place_of_a_snapshot(
    tmp_path: Path, stored_config: SceneConfig
) -> None:
    snapshot(stored_config.output / FILE, stored_config, 2)
    other = snapshot(tmp_path / "other" / FILE, stored_config.model_copy(update={"seed": 4}), 9)
    put(other, stored_config)
    fetch_snapshot(stored_config)
    assert place(stored_config.output / FILE) == (2, 0)
    (tmp_path / "damaged").write_bytes(snapshot(other, stored_config, 9).read_bytes()[:-30])
    put(tmp_path / "damaged", stored_config)
    fetch_snapshot(stored_config)
    assert place(stored_config.output / FILE) == (2, 0)


def test_a_run_is_resumed_on_a_machine_that_has_nothing_of_it(tmp_path: Path, stored_config: SceneConfig) -> None:
    with pytest.raises(InputError, match="no such folder"):
        load_resumed(tmp_path / "moved", tmp_path / "scene.yaml", [])
    put(snapshot(tmp_path / "other" / FILE, stored_config, 6), stored_config)
    resumed, found = load_resumed(tmp_path / "moved", tmp_path / "scene.yaml", [])
    assert found is not None and found.position.events == 6 and resumed.output == tmp_path / "moved"
    with pytest.raises(InputError, match="seed: 0, not 4"):
        load_resumed(tmp_path / "again", tmp_path / "scene.yaml", ["seed=4"])
    with pytest.raises(StorageError):
        fetch_snapshot(stored_config.model_copy(update={"snapshot_store": "nonsense://x"}))
