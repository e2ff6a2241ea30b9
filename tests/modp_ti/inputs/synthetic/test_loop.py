"""The loop with drift: what a tracker believes on the way, and what its correction says."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.se3 import inverse_se3
from modp_ti.inputs.synthetic import Loop, SyntheticTracker, TrackerNoise
from modp_ti.inputs.synthetic.camera_path import camera_path
from modp_ti.inputs.synthetic.renderer import RoomRenderer
from modp_ti.outputs.evaluation import umeyama

pytestmark = pytest.mark.slow

Make = Callable[..., SyntheticTracker]


@pytest.fixture
def make(room: RoomRenderer) -> Make:
    def build(**options: object) -> SyntheticTracker:
        noise = TrackerNoise.none()
        return SyntheticTracker(
            **{"width": 64, "height": 48, "frames": 20, "points": 60, "noise": noise, "room": room, **options}
        )

    return build


def frames_of(items: list) -> list[TrackedFrame]:
    return [item for item in items if isinstance(item, TrackedFrame)]


def centre(T: np.ndarray) -> np.ndarray:
    return inverse_se3(T)[:3, 3]


def test_the_camera_comes_back_to_where_it_began() -> None:
    path = camera_path(101, loop=True)
    assert np.linalg.norm(centre(path[90]) - centre(path[0])) < 0.05
    assert np.degrees(np.arccos(path[90][2, :3] @ path[0][2, :3])) < 3
    steps = np.linalg.norm(np.diff([centre(T) for T in path], axis=0), axis=1)
    assert steps.max() < 0.06
    ways = np.array([T[2, :3] for T in path])
    assert (ways @ ways[0]).min() < -0.8  # it has looked the other way


def test_poses_and_points_of_a_frame_drift_together(make: Make) -> None:
    tracker = make(loop=Loop(0.05))
    truth = tracker.ground_truth()
    drifted = list(tracker.events())
    for frame in drifted:
        T = frame.T_camera_world
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
        p = frame.points.xyz @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(frame.camera.project(p), frame.points.pixels, atol=1e-6)
    off = [np.linalg.norm(centre(f.T_camera_world) - centre(T)) for f, T in zip(drifted, truth, strict=True)]
    assert off[0] == pytest.approx(0.0, abs=1e-9)
    # It adds up: 0.05 of the scene's depth of 2.5 m where the loop closes, beside what turn and scale make of the way.
    assert off[18] == pytest.approx(0.125, rel=0.4)
    assert off[5] < off[11] < off[18]
    # Depths have grown by the scale.
    exact = list(make(loop=Loop()))[18]
    ids, a, b = np.intersect1d(drifted[18].points.ids, exact.points.ids, return_indices=True)
    ratio = drifted[18].points.depths(drifted[18].T_camera_world)[a] / exact.points.depths(truth[18])[b]
    assert len(ids) > 20
    np.testing.assert_allclose(ratio, np.exp(0.05 * (18 / 19) / 0.9), rtol=1e-9)


@pytest.mark.parametrize(("stop", "place"), [(20, 18), (12, 12)])
def test_the_correction_comes_where_the_loop_closes_or_at_the_end_and_is_right(
    make: Make, stop: int, place: int
) -> None:
    options = {"select": slice(0, stop), "metres_per_unit": 0.4}
    tracker = make(loop=Loop(0.05, corrected=True), **options)
    items = list(tracker.events())
    (at,) = [i for i, item in enumerate(items) if isinstance(item, PoseCorrection)]
    assert at == place and len(items) == stop + 1
    correction, frames = items[at], frames_of(items)
    assert correction.index.tolist() == list(range(place))
    exact = list(make(loop=Loop(), **options))
    for i in range(place):
        np.testing.assert_allclose(correction.T_camera_world[i], exact[i].T_camera_world, atol=1e-12)
    where = dict(zip(correction.ids.tolist(), correction.xyz, strict=True))
    for frame, right in zip(frames, exact, strict=True):
        np.testing.assert_array_equal(frame.image, right.image)
        if frame.index < place:
            assert set(frame.points.ids.tolist()) <= set(where)
            moved = np.array([where[i] for i in right.points.ids.tolist()]).reshape(-1, 3)
            np.testing.assert_allclose(moved, right.points.xyz, atol=1e-12)
        else:
            np.testing.assert_allclose(frame.T_camera_world, right.T_camera_world, atol=1e-12)
            np.testing.assert_allclose(frame.points.xyz, right.points.xyz, atol=1e-12)
    # Wrong before: no similarity makes the whole way right.
    source, target = (np.array([centre(f.T_camera_world) for f in side[:place]]) for side in (frames, exact))
    s, R, t = umeyama(source, target)
    assert np.linalg.norm(s * source @ R.T + t - target, axis=1).max() > 0.01


def test_iterating_afterwards_gives_the_poses_of_the_end(make: Make) -> None:
    corrected, exact = make(loop=Loop(0.05, corrected=True)), make(loop=Loop())
    for a, b in zip(corrected, exact, strict=True):
        np.testing.assert_allclose(a.T_camera_world, b.T_camera_world, atol=1e-12)


def test_without_drift_the_correction_says_what_the_frames_said(make: Make) -> None:
    items = list(make(loop=Loop(0.0, corrected=True)).events())
    (correction,) = [item for item in items if isinstance(item, PoseCorrection)]
    for i, frame in enumerate(frames_of(items)[: len(correction.index)]):
        np.testing.assert_array_equal(correction.T_camera_world[i], frame.T_camera_world)
