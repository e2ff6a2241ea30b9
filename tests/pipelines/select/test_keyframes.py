from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.keyframes import KeyframeStore
from fields.map.trajectory import Trajectory
from pipelines.select.keyframes import KeyframeSelector
from pipelines.settings import KeyframeSettings

CAMERA = PinholeCamera(10.0, 10.0, 10.0, 10.0, 20, 20)  # sees |x| < z and |y| < z
IMAGE = np.zeros((20, 20, 3), dtype=np.float32)


def pose(x: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """Camera at (x, 0, 0), turned by yaw degrees."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", yaw, degrees=True).as_matrix()
    T[:3, 3] = -T[:3, :3] @ [x, 0, 0]
    return T


def frame(index: int, x: float = 0.0, yaw: float = 0.0, points: int = 30) -> TrackedFrame:
    T = pose(x, yaw)
    rng = np.random.default_rng(3)
    local = rng.uniform([-0.5, -0.5, 1.0], [0.5, 0.5, 1.0], (points, 3))
    local[:1] = [0.0, 0.0, 5.0]  # nothing of the others is beyond the farthest point
    xyz = (local - T[:3, 3]) @ T[:3, :3]
    sparse = SparsePoints(xyz, CAMERA.project(local), np.arange(points))
    return TrackedFrame(index, index / 30, str(index), IMAGE, CAMERA, T, sparse)


def decisions(frames: list[TrackedFrame], **settings: Any) -> list[bool]:
    """What becomes of every frame of a stream."""
    trajectory = Trajectory()
    store = KeyframeStore(trajectory=trajectory)
    selector = KeyframeSelector(KeyframeSettings(**settings), trajectory)
    result = []
    for f in frames:
        trajectory.add(f)
        result.append(selector.is_keyframe(f, next(iter(store.before(f.index, 1)), None)))
        if result[-1]:
            store.append(f)
    return result


def test_the_first_frame_with_points_is_a_keyframe() -> None:
    assert decisions([frame(0, points=3), frame(1), frame(2)]) == [False, True, False]


def test_each_view_of_a_rig_is_compared_with_its_own_last_keyframe() -> None:
    at = [0.0, 0.0, 0.001, 0.002, 0.5, 0.5]  # median depth 1
    frames = [replace(frame(2 * i + view, x, yaw=90 * view), views=2) for i, x in enumerate(at) for view in (0, 1)]
    made = decisions(frames, max_gap=9, covisibility=0.5)
    assert made == [True, True, *[False] * 6, True, True, False, False]
    standing = [
        replace(each, T_camera_world=frame(0, yaw=90 * (i % 2)).T_camera_world) for i, each in enumerate(frames)
    ]
    assert decisions(standing, max_gap=3) == [i // 2 in (0, 4) for i in range(12)]


def test_a_standing_camera_gives_a_keyframe_after_the_largest_gap() -> None:
    assert decisions([frame(i) for i in range(9)], max_gap=3) == [True, False, False, False, True] + [False] * 3 + [
        True
    ]


def test_losing_sight_of_points_makes_a_keyframe() -> None:
    # Points up to 27 degrees off the axis, borders at 45: they begin to leave after some 20 degrees.
    turning = [frame(i, yaw=8 * i) for i in range(5)]
    assert decisions(turning, baseline=10.0, max_gap=9) == [True, False, False, True, False]


def test_moving_makes_a_keyframe_although_all_points_stay_in_view() -> None:
    assert decisions([frame(0), frame(1, x=0.01), frame(2, x=0.04)], covisibility=0.0) == [True, False, True]


def test_a_sudden_turn_is_no_keyframe_where_the_picture_is_blurred() -> None:
    rng = np.random.default_rng(0)
    # Large enough for a mean of noise: blurred, its sharpness is 0.62 to 0.72 of what it was (1,000 draws).
    camera = PinholeCamera(40.0, 40.0, 40.0, 40.0, 80, 80)
    sharp = cv2.GaussianBlur(rng.uniform(0, 1, (80, 80, 3)).astype(np.float32), (0, 0), 0.7)
    blurred = cv2.blur(sharp, (5, 1))
    steady = [replace(frame(i, x=0.1 * i, yaw=i), image=sharp, camera=camera) for i in range(4)]
    for picture, becomes_one in ((sharp, True), (blurred, False)):
        turned = replace(frame(4, x=0.4, yaw=20), image=picture, camera=camera)
        assert decisions([*steady, turned]) == [True] * 4 + [becomes_one]


def test_a_steady_camera_may_blur() -> None:
    """By the focus, or in the dark: other pictures there are not."""
    rng = np.random.default_rng(0)
    sharp = rng.uniform(0, 1, (20, 20, 3)).astype(np.float32)
    frames = [replace(frame(0), image=sharp), replace(frame(1, x=0.1, yaw=5), image=cv2.blur(sharp, (5, 5)))]
    assert decisions(frames) == [True, True]


def test_each_keyframe_is_followed_by_one_sharp_frame_at_most() -> None:
    rng = np.random.default_rng(5)
    sharp = rng.uniform(0, 1, (20, 20, 3)).astype(np.float32)
    blurred = cv2.GaussianBlur(sharp, (0, 0), 2.0)
    images = dict.fromkeys(range(12), sharp) | {2: blurred}
    for between, expected in ((0, []), (1, [1, 7]), (2, [3, 8]), (9, [])):
        trajectory = Trajectory()
        store = KeyframeStore(trajectory=trajectory)
        selector = KeyframeSelector(KeyframeSettings(between=between), trajectory)
        for i in range(12):
            f = replace(frame(i), image=images[i])
            if i % 6 == 0:
                store.append(f)
            elif selector.is_between(f, store):
                store.append(f, is_between=True)
        assert [view.index for view in store if view.is_between] == expected
