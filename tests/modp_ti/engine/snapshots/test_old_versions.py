"""Snapshots that earlier versions wrote are read as if this one had written them; damaged ones get one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fields.geometry.se3 import exp_se3
from fields.map.trajectory import Trajectory
from modp_ti.engine.snapshots import Snapshot
from modp_ti.engine.snapshots import file as snapshot_file
from modp_ti.engine.snapshots.file import FILE, write_arrays
from modp_ti.files.errors import InputError

POSES = np.stack([exp_se3([0.1 * i, 0.0, 0.0, 0.0, 0.2, 0.0]) for i in range(3)])
ARRAYS = {
    "frames.index": np.arange(3),
    "frames.held_out": np.array([False, True, False]),
    "frames.T_tracked": POSES,
    "tracked.index": np.array([0, 2]),
    "tracked.T": POSES[[0, 2]],
}


def write(folder: Path, monkeypatch: pytest.MonkeyPatch, arrays: dict, before: object, version: int = 2) -> Path:
    monkeypatch.setattr(snapshot_file, "VERSION", version)
    position = {"events": 3, "digest": 5, "finished": False, "refined": 0}
    numbers = {"map": {"gate": {"before": before}}}
    write_arrays(folder / FILE, arrays, {"settings": {}, "position": position, "numbers": numbers})
    monkeypatch.undo()
    return folder / FILE


def test_version_2_has_one_trajectory_of_all_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, monkeypatch, ARRAYS, [[2, POSES[2].tolist()], None])
    snapshot = Snapshot.read(path)
    trajectory = Trajectory()
    trajectory.restore(snapshot.map.group("tracked"))
    assert list(trajectory) == [0, 1, 2] and trajectory.held_out == {1}
    np.testing.assert_array_equal(list(trajectory.values()), POSES)
    assert snapshot.numbers["map"]["gate"]["before"] == [2, None]


def test_version_3_leaves_its_marks_of_voxels_to_the_gaussians(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    marks = {"voxels.places": np.zeros((1, 4), np.int32), "voxels.words": np.ones(1, np.uint64)}
    gaussians = {"gaussians.opacity_logit": np.zeros(4, np.float32)}
    snapshot = Snapshot.read(write(tmp_path, monkeypatch, gaussians | marks, [], version=3))
    assert list(snapshot.arrays) == ["gaussians.opacity_logit"] and snapshot.map.group("voxels") == {}
    assert snapshot.numbers["map"] == {"gate": {"before": []}, "voxels_made_again": True}


@pytest.mark.parametrize(("missing", "before"), [("frames.T_tracked", []), ("", [[]]), ("", None), ("", [3])])
def test_a_damaged_one_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str, before: object
) -> None:
    arrays = {name: array for name, array in ARRAYS.items() if name != missing}
    path = write(tmp_path, monkeypatch, arrays, before)
    with pytest.raises(InputError, match="the parts of the snapshot do not fit together") as refused:
        Snapshot.read(path)
    assert "\n" not in str(refused.value)
