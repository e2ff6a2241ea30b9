"""Frames and corrections of a tracker that follow the frames of an earlier map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from fields.frames.pose_correction import CameraRevision, PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3
from modp_ti.files.errors import InputError
from modp_ti.inputs.joined_tracker import JoinedTracker, Placement, prefix_for, shift_after
from modp_ti.inputs.protocol import Before, Event, Tracker
from modp_ti.inputs.sources import Picture

CAMERA = PinholeCamera(80.0, 80.0, 40.0, 30.0, 80, 60)
S = np.diag([2.0, 2.0, 2.0, 1.0]) @ exp_se3([1.0, -2.0, 0.5, 0.3, 1.0, -0.4])
PICTURE = Picture(np.zeros((60, 80, 3), dtype=np.float32), None, None, CAMERA)
PLACEMENT = Placement(S, first=3, shift=10.0, prefix="visit2/")


def frame(index: int) -> TrackedFrame:
    rng = np.random.default_rng(index)
    T = exp_se3(0.1 * rng.normal(size=6))
    local = CAMERA.unproject(rng.uniform(5, 55, (6, 2)), rng.uniform(1, 4, 6))
    points = SparsePoints((local - T[:3, 3]) @ T[:3, :3], CAMERA.project(local), np.arange(6) + index)
    image = np.zeros((60, 80, 3), dtype=np.float32)
    return TrackedFrame(index, index / 10, f"{index}.png", image, CAMERA, T, points, held_out=index == 1)


class Earlier:
    """Three frames of an earlier map."""

    size, end = (80, 60), 0.2

    def __len__(self) -> int:
        return 3

    def __iter__(self) -> Iterator[TrackedFrame]:
        return map(frame, range(3))

    def pictures(self, names: Sequence[str]) -> Iterator[tuple[str, Picture]]:
        return ((name, PICTURE) for name in names)


def correction(**more) -> PoseCorrection:
    return PoseCorrection(np.array([0]), exp_se3([0.1] * 6)[None], np.array([2]), np.ones((1, 3)), **more)


class Corrects(Tracker):
    """Delivers frames 0 to 3, and a correction after frame 1. The image of frame 2 cannot be read again."""

    @property
    def notes(self) -> list[str]:
        return []

    @property
    def frame_count(self) -> int:
        return 4

    def pictures(self, names: Sequence[str]) -> Iterator[tuple[str, Picture]]:
        return ((name, PICTURE) for name in names if name != "2.png")

    def __iter__(self) -> Iterator[Event]:
        yield from map(frame, range(2))
        yield correction()
        yield from map(frame, range(2, 4))


def joined() -> JoinedTracker:
    tracker = Corrects()
    events = iter(tracker)
    taken = [next(events) for _ in range(3)]
    return JoinedTracker(Earlier(), tracker, PLACEMENT, taken, events)


def test_a_placed_frame_shows_the_same_image_of_the_other_world() -> None:
    before, after = frame(1), PLACEMENT.frame(frame(1))
    T, points = after.T_camera_world, after.points
    np.testing.assert_allclose(CAMERA.project(points.xyz @ T[:3, :3].T + T[:3, 3]), before.points.pixels, atol=1e-9)
    np.testing.assert_allclose(points.depths(T), 2.0 * before.points.depths(before.T_camera_world))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert (after.index, after.timestamp, after.name, after.held_out) == (4, 10.1, "visit2/1.png", True)
    np.testing.assert_array_equal(points.ids, before.points.ids)


def test_frames_and_corrections_follow_those_of_the_earlier_map() -> None:
    events = list(joined())
    frames = [event for event in events if isinstance(event, TrackedFrame)]
    assert [each.index for each in frames] == list(range(7))
    assert (np.diff([each.timestamp for each in frames]) > 0).all()
    assert len({each.name for each in frames}) == 7
    assert isinstance(events[5], PoseCorrection), "in its place, after two of the new frames"
    assert (events[5].index.tolist(), events[5].others_stay) == ([3], True)
    names = [each.name for each in frames]
    assert [name for name, _ in joined().pictures(names)] == [name for name in names if name != "visit2/2.png"]


def test_a_corrected_pose_is_that_of_a_frame_with_it() -> None:
    event = PLACEMENT.correction(correction())
    wanted = PLACEMENT.frame(
        TrackedFrame(0, 0.0, "", np.zeros((60, 80, 3), dtype=np.float32), CAMERA, exp_se3([0.1] * 6))
    )
    np.testing.assert_allclose(event.T_camera_world[0], wanted.T_camera_world)
    np.testing.assert_allclose(event.xyz, np.ones((1, 3)) @ S[:3, :3].T + S[:3, 3])


def test_a_revised_camera_is_refused() -> None:
    with pytest.raises(InputError, match=r"give source\.intrinsics"):
        PLACEMENT.correction(correction(camera=CameraRevision(CAMERA)))


def test_the_tracker_says_what_comes_before() -> None:
    tracker = joined()
    assert tracker.frame_count == 7
    assert tracker.before == Before(3, 80, 60, 10.0)
    assert Corrects().before == Before()


def test_times_are_shifted_only_if_they_are_not_later_anyway() -> None:
    assert shift_after(5.0, 5.1) == 0.0
    assert shift_after(5.0, 5.0) + 5.0 > 5.0
    assert shift_after(1e9, 0.0) > 1e9


def test_each_visit_has_a_prefix_of_its_own() -> None:
    assert prefix_for(["a.png", "b/visit7/c.png", "visitors/d.png"]) == "visit2/"
    assert prefix_for(["a.png", "visit2/a.png", "visit10/a.png"]) == "visit11/"
