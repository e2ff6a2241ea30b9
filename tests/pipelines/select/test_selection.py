"""Which frames become keyframes, which keyframes a step sees, and how sharp a picture is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.keyframes import KeyframeStore
from fields.map.trajectory import Trajectory
from pipelines.select.gate import sharpness
from pipelines.select.keyframes import KeyframeSelector
from pipelines.select.views import LocalGlobalViews, global_probabilities
from pipelines.settings import KeyframeSettings, ViewSettings

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


NARROW = PinholeCamera(10.0, 10.0, 10.0, 10.0, 20, 20)


def store(errors: list[float], far: tuple[int, ...] = ()) -> KeyframeStore:
    """Keyframes side by side; those in `far` look at another place."""
    result = KeyframeStore()
    for index, error in enumerate(errors):
        T = np.eye(4)
        T[0, 3] = 1000.0 if index in far else -0.01 * index
        xyz = np.array([[0.0, 0.0, 2.0], [0.5, 0.5, 2.0]]) - T[:3, 3]
        points = SparsePoints(xyz, np.full((2, 2), 10.0), np.arange(2))
        image = np.zeros((20, 20, 3), dtype=np.float32)
        result.append(TrackedFrame(index, 0.0, str(index), image, NARROW, T, points)).error = error
    return result


def test_global_probabilities_are_equation_2() -> None:
    errors = [0.01, 0.05, 0.02]
    weights = [np.exp(50 * e) * np.exp(0.3 * (j - 2)) for j, e in enumerate(errors)]
    p = global_probabilities(store(errors), 50.0, 0.3, np.arange(3))
    np.testing.assert_allclose(p, np.array(weights) / sum(weights))
    p = global_probabilities(store(errors), 50.0, 0.3, np.array([0, 2]))
    np.testing.assert_allclose(p, np.array(weights)[[0, 2]] / (weights[0] + weights[2]))


def test_keyframes_that_have_fallen_below_their_own_best_are_drawn_more() -> None:
    keyframes = store([0.03, 0.03, 0.03, 0.03])
    keyframes[1].note_error(0.01, level=1)  # of a smaller image, whose errors are smaller
    keyframes[1].note_error(0.03)
    keyframes[2].note_error(0.02)
    keyframes[2].note_error(0.03)
    p = global_probabilities(keyframes, 20.0, 0.0, np.arange(4), recovery=3.0)
    np.testing.assert_allclose(p / p[0], [1.0, 1.0, 1.5**3, 1.0])


def test_a_step_looks_at_one_current_one_local_and_four_global_views() -> None:
    views = LocalGlobalViews(ViewSettings(local_views=1, global_views=4), np.random.default_rng(0))
    keyframes = store([0.1] * 30)
    views.begin(keyframes, np.arange(len(keyframes)))
    draws = np.array([views.select(keyframes) for _ in range(300)])
    assert draws.shape == (300, 6)
    assert (draws[:, 0] == 29).all()
    assert set(draws[:, 1]) == set(range(19, 29))  # the ten before the current one
    assert len(set(draws[:, 2:].ravel())) == 30


def test_global_views_follow_their_probabilities() -> None:
    settings = ViewSettings(local_views=0, global_views=1)
    views = LocalGlobalViews(settings, np.random.default_rng(1))
    keyframes = store([0.00, 0.02, 0.04])
    views.begin(keyframes, np.arange(len(keyframes)))
    drawn = np.bincount([views.select(keyframes)[1] for _ in range(4000)], minlength=3) / 4000
    expected = global_probabilities(keyframes, settings.error_weight, 0.001, np.arange(3))
    np.testing.assert_allclose(drawn, expected, atol=0.03)


def test_local_views_are_drawn_by_covisibility() -> None:
    views = LocalGlobalViews(ViewSettings(local_views=1, global_views=0), np.random.default_rng(2))
    keyframes = store([0.1] * 4, far=(0, 1))
    views.begin(keyframes, np.arange(len(keyframes)))
    assert {views.select(keyframes)[1] for _ in range(100)} == {2}


def test_only_keyframes_that_are_near_are_drawn() -> None:
    views = LocalGlobalViews(ViewSettings(local_views=2, global_views=3), np.random.default_rng(4))
    keyframes = store([0.1] * 6)
    views.begin(keyframes, np.array([1, 2, 4]))
    draws = np.array([views.select(keyframes) for _ in range(100)])
    assert (draws[:, 0] == 5).all()
    assert set(draws[:, 1:].ravel()) == {1, 2, 4}


def test_a_frame_after_the_latest_keyframe_is_a_global_view_only() -> None:
    keyframes = store([0.1] * 4)
    T, image = np.eye(4), np.zeros((20, 20, 3), dtype=np.float32)
    keyframes.append(TrackedFrame(9, 0.3, "9", image, NARROW, T, keyframes[0].points), is_between=True)
    views = LocalGlobalViews(ViewSettings(local_views=1, global_views=2), np.random.default_rng(3))
    views.begin(keyframes, np.arange(len(keyframes)))
    draws = np.array([views.select(keyframes) for _ in range(100)])
    assert (draws[:, 0] == 3).all() and set(draws[:, 1]) == {0, 1, 2} and set(draws[:, 2:].ravel()) == set(range(5))


def photograph(seed: int, size: tuple[int, int] = (120, 160)) -> np.ndarray:
    """Edges of many sizes and directions, without steps: (H, W, 3) uint8."""
    rng = np.random.default_rng(seed)
    image = np.full((*size, 3), 90, dtype=np.uint8)
    for _ in range(150):
        corners = rng.uniform((0, 0), size[::-1], (1, 2)) + rng.uniform(-25, 25, (3, 2))
        cv2.fillPoly(image, [corners.astype(np.int32)], rng.uniform(0, 255, 3).tolist(), lineType=cv2.LINE_AA)
    return image


def smeared(image: np.ndarray, pixels: int, degrees: float) -> np.ndarray:
    """`image` as a camera that moves by `pixels` while its shutter is open takes it."""
    steps = np.linspace(-0.5, 0.5, 4 * pixels) * pixels
    x, y = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    height, width = image.shape[:2]
    moved = [
        cv2.warpAffine(image.astype(np.float32), np.array([[1, 0, s * x], [0, 1, s * y]]), (width, height))
        for s in steps
    ]
    return np.mean(moved, axis=0).astype(np.uint8)


@pytest.mark.parametrize("degrees", [0, 30, 45, 90, 135])
@pytest.mark.parametrize("pixels", [3, 6])
def test_moving_along_any_line_takes_a_quarter(pixels: int, degrees: float) -> None:
    assert sharpness(smeared(photograph(1), pixels, degrees)) < 0.75 * sharpness(photograph(1))


def test_brightness_and_contrast_do_not_count() -> None:
    image = photograph(2)
    assert sharpness((0.4 * image + 50).astype(np.uint8)) == pytest.approx(sharpness(image), rel=0.05)
