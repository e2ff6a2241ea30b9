"""What a run keeps of its frames follows the tracker's corrections."""

from __future__ import annotations

import numpy as np
import pytest

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3, inverse_se3
from modp_ti.inputs import delivered_frames
from modp_ti.inputs.delivered_frames import DeliveredFrames, RowsOfIds

CAMERA = PinholeCamera(40.0, 40.0, 16.0, 12.0, 32, 24)
DEPTHS = np.array([1.0, 2.0, 3.0])


def pose(index: int) -> np.ndarray:
    return exp_se3([0.05 * index, 0.0, 0.0, 0.0, 0.02 * index, 0.0])


@pytest.fixture
def frames() -> DeliveredFrames:
    """Four frames, each with three points that none of the others sees."""
    delivered = DeliveredFrames()
    pixels = np.array([[4.5, 4.5], [20.5, 7.5], [10.5, 18.5]])
    image = np.full((24, 32, 3), 0.5, dtype=np.float32)
    for index in range(4):
        T = pose(index)
        xyz = CAMERA.unproject(pixels, DEPTHS) @ T[:3, :3] + inverse_se3(T)[:3, 3]
        points = SparsePoints(xyz, pixels, np.arange(3) + 10 * index)
        delivered.add(TrackedFrame(index, 0.1 * index, f"{index}", image, CAMERA, T, points))
    return delivered


def test_points_move_with_the_world_around_their_frames(frames: DeliveredFrames) -> None:
    S = exp_se3([0.3, -0.2, 0.1, 0.1, 0.2, -0.3])
    corrected = np.stack([pose(i) @ inverse_se3(S) for i in range(4)])
    before = frames.points.xyz.copy()
    frames.trajectory.revise(dict(enumerate(corrected)))
    frames.correct(PoseCorrection(np.array([1, 2]), corrected[1:3]), dict.fromkeys(range(4), S), moved=True)
    np.testing.assert_array_equal(frames.T_tracked, corrected)
    np.testing.assert_allclose(frames.points.xyz, before @ S[:3, :3].T + S[:3, 3], atol=1e-12)
    assert frames.points.reprojection_error(frames.camera, frames.T_tracked) == pytest.approx(0.0, abs=1e-5)
    assert frames.corrections == {"received": 1, "moved": 1}


def test_points_of_frames_whose_world_stays_do_not_move(frames: DeliveredFrames) -> None:
    S = exp_se3([0.3, -0.2, 0.1, 0.1, 0.2, -0.3])
    before = frames.points.xyz.copy()
    frames.correct(PoseCorrection(np.array([2]), pose(2)[None], others_stay=True), {2: S}, moved=True)
    moved = np.arange(3) + 6  # the points of frame 2, which no other frame sees
    np.testing.assert_array_equal(np.flatnonzero((frames.points.xyz != before).any(axis=1)), moved)
    np.testing.assert_allclose(frames.points.xyz[moved], before[moved] @ S[:3, :3].T + S[:3, 3], atol=1e-12)


def test_points_that_the_tracker_names_are_where_it_says(frames: DeliveredFrames) -> None:
    before = frames.points.xyz.copy()
    correction = PoseCorrection(
        np.array([0]), pose(0)[None], np.array([21, 99]), np.array([[7.0, 8.0, 9.0], [0, 0, 0]])
    )
    frames.correct(correction, {}, moved=False)
    changed = (frames.points.xyz != before).any(axis=1)
    np.testing.assert_array_equal(frames.points.ids[changed], [21])
    np.testing.assert_array_equal(frames.points.xyz[changed], [[7.0, 8.0, 9.0]])
    assert frames.corrections == {"received": 1, "moved": 0}


def test_rows_are_those_of_a_dictionary(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(delivered_frames, "RECENT", 20)
    rng, rows, expected = np.random.default_rng(1), RowsOfIds(), {}
    for frame in range(60):
        ids = rng.integers(-50, 50 + 20 * frame, 40)  # some known, some new, some twice
        np.testing.assert_array_equal(rows.find(ids), [expected.get(i, -1) for i in ids.tolist()])
        np.testing.assert_array_equal(rows.take(ids), [expected.setdefault(i, len(expected)) for i in ids.tolist()])
        assert len(rows) == len(expected)
        np.testing.assert_array_equal(rows.ids, list(expected))
    again = RowsOfIds(rows.ids)
    ids = np.array([*expected, 10**12, -(2**62)])
    np.testing.assert_array_equal(again.find(ids), [*expected.values(), -1, -1])


def test_no_ids_have_no_rows() -> None:
    rows, none = RowsOfIds(), np.zeros(0, dtype=np.int64)
    assert len(rows.find(none)) == len(rows.take(none)) == len(rows) == len(rows.ids) == 0
    np.testing.assert_array_equal(rows.find(np.array([3])), [-1])
