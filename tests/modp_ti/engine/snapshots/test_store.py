"""Copies of snapshots: the further one is taken, and a storage that fails costs one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.engine.snapshots import fetch_snapshot, load_resumed
from modp_ti.engine.snapshots.file import FILE, read_arrays, write_arrays
from modp_ti.engine.snapshots.store import SnapshotStore
from modp_ti.files.errors import InputError
from modp_ti.files.storage import StorageError

SCENE = "source: {path: images, scale: 1}\ntracker: {kind: colmap}\noutput: out\nsnapshot_every: 3\n"


def snapshot(file: Path, events: int, refined: int = 0, **settings: object) -> Path:
    """A snapshot file of which nothing but its place in the run and its settings is real."""
    file.parent.mkdir(parents=True, exist_ok=True)
    position = {"events": events, "digest": 5, "finished": refined > 0, "refined": refined}
    write_arrays(file, {"a": np.zeros(1)}, {"settings": settings, "position": position, "numbers": {}})
    return file


def events(file: Path) -> tuple[int, int]:
    position = read_arrays(file)[1]["position"]
    return position["events"], position["refined"]


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
    tmp_path: Path, here: tuple[int, int] | None, there: tuple[int, int] | None, expected: tuple[int, int]
) -> None:
    store = SnapshotStore(f"file://{tmp_path}/store", pytest.fail)
    if there is not None:
        store.put(snapshot(tmp_path / "other" / FILE, *there))
    if here is not None:
        snapshot(tmp_path / "out" / FILE, *here)
    fetch_snapshot(f"file://{tmp_path}/store", tmp_path / "out")
    assert events(tmp_path / "out" / FILE) == expected


def test_a_damaged_copy_does_not_take_the_place_of_a_snapshot(tmp_path: Path) -> None:
    (tmp_path / "damaged").write_bytes(snapshot(tmp_path / "other" / FILE, 9).read_bytes()[:-30])
    SnapshotStore(f"file://{tmp_path}/store", pytest.fail).put(tmp_path / "damaged")
    snapshot(tmp_path / "out" / FILE, 2)
    fetch_snapshot(f"file://{tmp_path}/store", tmp_path / "out")
    assert events(tmp_path / "out" / FILE) == (2, 0)


def test_a_storage_that_fails_is_said_once_and_left_alone_after_the_second_time(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    said: list[str] = []
    store = SnapshotStore(f"file://{tmp_path}/file/store", said.append)
    taken = snapshot(tmp_path / "out" / FILE, 2)
    for _ in range(4):
        store.put(taken)
    (line,) = said
    assert line.endswith("Not a directory; snapshots stay on this machine, and the run continues")
    (tmp_path / "file").unlink()
    store.put(taken)
    assert not (tmp_path / "file").exists(), "it was tried again"


def test_a_run_is_resumed_on_a_machine_that_has_nothing_of_it(tmp_path: Path) -> None:
    url = f"file://{tmp_path}/store"
    (tmp_path / "scene.yaml").write_text(f"{SCENE}snapshot_store: {url}\n")
    config = load_scene(tmp_path / "scene.yaml")
    with pytest.raises(InputError, match="no such folder"):
        load_resumed(tmp_path / "out", tmp_path / "scene.yaml", [])
    taken = snapshot(tmp_path / "other" / FILE, 6, **config.model_dump(mode="json"))
    SnapshotStore(url, pytest.fail).put(taken)
    resumed, found = load_resumed(tmp_path / "out", tmp_path / "scene.yaml", [])
    assert found.position.events == 6 and resumed.output == tmp_path / "out"


def test_a_storage_that_cannot_be_read_is_said(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="cannot be opened"):
        fetch_snapshot("nonsense://x", tmp_path / "out")
    assert not (tmp_path / "out").exists()
