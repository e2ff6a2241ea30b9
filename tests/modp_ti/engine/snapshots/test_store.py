"""Copies of snapshots: the further one is taken, and a storage that fails costs one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.snapshots import FILE, Snapshot, fetch_snapshot, load_resumed
from modp_ti.engine.snapshots.checkpointer import SnapshotStore
from modp_ti.engine.snapshots.snapshot import Position
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import list_files
from modp_ti.files.storage import StorageError

SCENE = "source: {path: images, scale: 1}\ntracker: {kind: colmap}\noutput: out\nsnapshot_every: 3\n"


@pytest.fixture
def config(tmp_path: Path) -> SceneConfig:
    (tmp_path / "scene.yaml").write_text(f"{SCENE}snapshot_store: file://{tmp_path}/store\n")
    return load_scene(tmp_path / "scene.yaml")


def snapshot(file: Path, config: SceneConfig, events: int, refined: int = 0) -> Path:
    """A snapshot file of which nothing but its place in the run and its settings is real."""
    file.parent.mkdir(parents=True, exist_ok=True)
    position = Position(events, 5, refined > 0, refined)
    Snapshot(file, config.model_dump(mode="json"), position, {"a": np.zeros(1)}, {}).write(file)
    return file


def put(file: Path, config: SceneConfig) -> None:
    assert config.snapshot_store is not None
    SnapshotStore(config.snapshot_store, pytest.fail).put(file)


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
    config: SceneConfig,
    here: tuple[int, int] | None,
    there: tuple[int, int] | None,
    expected: tuple[int, int],
) -> None:
    if there is not None:
        put(snapshot(tmp_path / "other" / FILE, config, *there), config)
    if here is not None:
        snapshot(config.output / FILE, config, *here)
        list_files(config.output, [FILE])
    fetch_snapshot(config)
    assert place(config.output / FILE) == expected


def test_a_copy_that_is_damaged_or_of_other_settings_does_not_take_the_place_of_a_snapshot(
    tmp_path: Path, config: SceneConfig
) -> None:
    snapshot(config.output / FILE, config, 2)
    other = snapshot(tmp_path / "other" / FILE, config.model_copy(update={"seed": 4}), 9)
    put(other, config)
    fetch_snapshot(config)
    assert place(config.output / FILE) == (2, 0)
    (tmp_path / "damaged").write_bytes(snapshot(other, config, 9).read_bytes()[:-30])
    put(tmp_path / "damaged", config)
    fetch_snapshot(config)
    assert place(config.output / FILE) == (2, 0)


def test_a_storage_that_fails_is_said_once_and_left_alone_after_the_second_time(
    tmp_path: Path, config: SceneConfig
) -> None:
    (tmp_path / "file").touch()
    said: list[str] = []
    store = SnapshotStore(f"file://{tmp_path}/file/store", said.append)
    taken = snapshot(config.output / FILE, config, 2)
    for _ in range(4):
        store.put(taken)
    (line,) = said
    assert line.endswith("Not a directory; snapshots stay on this machine, and the run continues")
    (tmp_path / "file").unlink()
    store.put(taken)
    assert not (tmp_path / "file").exists(), "it was tried again"


def test_a_run_is_resumed_on_a_machine_that_has_nothing_of_it(tmp_path: Path, config: SceneConfig) -> None:
    with pytest.raises(InputError, match="no such folder"):
        load_resumed(tmp_path / "moved", tmp_path / "scene.yaml", [])
    put(snapshot(tmp_path / "other" / FILE, config, 6), config)
    resumed, found = load_resumed(tmp_path / "moved", tmp_path / "scene.yaml", [])
    assert found.position.events == 6 and resumed.output == tmp_path / "moved"
    with pytest.raises(InputError, match="the snapshot was made with seed: 0, not 4"):
        load_resumed(tmp_path / "again", tmp_path / "scene.yaml", ["seed=4"])


def test_a_storage_that_cannot_be_read_is_said(config: SceneConfig) -> None:
    with pytest.raises(StorageError, match="cannot be opened"):
        fetch_snapshot(config.model_copy(update={"snapshot_store": "nonsense://x"}))
    assert not config.output.exists()
