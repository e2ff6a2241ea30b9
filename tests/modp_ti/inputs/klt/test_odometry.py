"""The odometry over made sequences with known poses: what it must follow, and what it must survive."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.klt.odometry import Odometry
from modp_ti.inputs.klt.tracking import Tracking, View
from modp_ti.outputs.evaluation import umeyama
from tests.room import look_at

pytestmark = pytest.mark.slow

BLACK = np.zeros((240, 320), np.uint8)


def processed(box_room, greys: list[NDArray[np.uint8]]) -> tuple[Odometry, dict[int, View]]:
    odometry, views = Odometry([Lens.pinhole(box_room.camera)]), {}
    for number, grey in enumerate(greys):
        for view in odometry.process(number, grey):
            assert view.number not in views
            views[view.number] = view
    return odometry, views


def tracked(box_room, greys: list[NDArray[np.uint8]]) -> tuple[Tracking, dict[int, View]]:
    odometry, views = processed(box_room, greys)
    assert odometry.tracking is not None
    return odometry.tracking, views


def errors(tracking: Tracking, views: dict[int, View], truth: dict[int, NDArray[np.float64]]) -> NDArray[np.float64]:
    """Distances [m] of camera centres from the true ones after the best similarity."""
    estimate = np.array([inverse_se3(tracking.pose(views[i]))[:3, 3] for i in truth])
    target = np.array([inverse_se3(T)[:3, 3] for T in truth.values()])
    s, R, t = umeyama(estimate, target)
    return np.linalg.norm(s * estimate @ R.T + t - target, axis=1)


def test_every_frame_of_a_walk_gets_its_pose_and_points_their_depth(box_room, box_walk):
    tracking, views = tracked(box_room, box_walk.grey)
    assert sorted(views) == list(range(60))  # those from before the map began too
    assert errors(tracking, views, dict(enumerate(box_walk.poses))).max() < 0.015  # of 1.8 m; 0.007 at most

    view = views[50]
    known = tracking.map.known[view.ids]
    assert known.sum() > 150
    T = tracking.pose(view)
    z = tracking.map.xyz[view.ids[known]] @ T[2, :3] + T[2, 3]
    ratio = z / box_room.depth(box_walk.poses[50], view.pixels[known])
    assert np.median(np.abs(ratio / np.median(ratio) - 1)) < 0.01


def test_a_turn_on_the_spot_makes_no_map(box_room):
    eye = np.array([-1.2, -1.2, 1.3])
    turns = [look_at(eye, np.array([x, 3.0, 1.0])) for x in np.linspace(-1.5, 0.5, 20)]
    odometry, views = processed(box_room, [box_room.grey(T) for T in turns])
    assert odometry.tracking is None and not views


def test_frames_that_only_turned_at_the_start_get_poses_once_there_is_a_map(box_room, box_walk):
    eye, target = inverse_se3(box_walk.poses[0])[:3, 3], np.array([-1.0, 3.0, 1.04])
    turns = [look_at(eye, target + np.array([x, 0.0, 0.0])) for x in np.linspace(-1.0, 0.0, 12, endpoint=False)]
    poses = [*turns, *box_walk.poses[:35]]
    tracking, views = tracked(box_room, [*(box_room.grey(T) for T in turns), *box_walk.grey[:35]])
    assert sorted(views) == list(range(47))
    assert errors(tracking, views, dict(enumerate(poses))).max() < 0.02


def test_repeated_frames_have_one_pose(box_room, box_walk):
    tracking, views = tracked(box_room, [grey for grey in box_walk.grey[:30] for _ in range(2)])
    assert len(views) == 60
    poses = [tracking.pose(views[i]) for i in range(60)]
    step = np.linalg.norm(inverse_se3(poses[58])[:3, 3] - inverse_se3(poses[56])[:3, 3])
    for a, b in zip(poses[40::2], poses[41::2], strict=True):
        assert np.linalg.norm(inverse_se3(a)[:3, 3] - inverse_se3(b)[:3, 3]) < 0.1 * step


def test_black_frames_are_skipped_and_the_camera_is_found_again(box_room, box_walk):
    greys = [BLACK, BLACK, *box_walk.grey[:30], BLACK, BLACK, BLACK, *box_walk.grey[27:50]]
    poses = [None, None, *box_walk.poses[:30], None, None, None, *box_walk.poses[27:50]]
    tracking, views = tracked(box_room, greys)
    assert sorted(views) == [i for i, T in enumerate(poses) if T is not None]
    assert tracking.recovered == 1
    assert errors(tracking, views, {i: T for i, T in enumerate(poses) if T is not None}).max() < 0.02


def test_after_a_cut_nothing_is_placed_until_the_scene_is_back(box_room, box_walk):
    rng = np.random.default_rng(3)
    elsewhere = [np.kron(rng.integers(0, 255, (30, 40)), np.ones((8, 8))).astype(np.uint8) for _ in range(4)]
    tracking, views = tracked(box_room, [*box_walk.grey[:30], *elsewhere, *box_walk.grey[20:40]])
    assert sorted(views) == [*range(30), *range(34, 54)]
    truth = {**dict(enumerate(box_walk.poses[:30])), **{34 + i: T for i, T in enumerate(box_walk.poses[20:40])}}
    assert errors(tracking, views, truth).max() < 0.02


def test_steps_too_wide_for_flow_are_crossed_by_features(box_room, box_walk):
    """From frame 25 to frame 50 the picture moves by 60 pixels and turns away."""
    order = [*range(26), *range(50, 60)]
    tracking, views = tracked(box_room, [box_walk.grey[i] for i in order])
    assert len(views) == len(order)
    assert errors(tracking, views, {n: box_walk.poses[i] for n, i in enumerate(order)}).max() < 0.02


@pytest.mark.parametrize("grey", [BLACK, np.full((240, 320), 90, np.uint8)])
def test_pictures_of_nothing_make_no_map(box_room, grey):
    odometry, views = processed(box_room, [grey] * 6)
    assert odometry.tracking is None and not views


def test_the_same_images_give_the_same_poses(box_room, box_walk):
    runs = [tracked(box_room, box_walk.grey[:35]) for _ in range(2)]
    a, b = ([tracking.pose(view) for view in views.values()] for tracking, views in runs)
    np.testing.assert_array_equal(a, b)


def test_light_that_changes_does_not_lose_the_camera(box_room, box_walk):
    greys = [np.clip(g * (0.8 + 0.3 * np.sin(i / 4)), 0, 255).astype(np.uint8) for i, g in enumerate(box_walk.grey)]
    tracking, views = tracked(box_room, greys)
    assert len(views) == 60
    assert errors(tracking, views, dict(enumerate(box_walk.poses))).max() < 0.02


def banded(grey: NDArray[np.uint8], phase: float, depth: float = 0.3) -> NDArray[np.uint8]:
    """The image under a lamp that flickers while the rows are exposed one after the other."""
    rows = np.arange(len(grey))[:, None]
    return np.clip(grey * (0.75 + depth * np.sin(2 * np.pi * (rows / 100.0 + phase))), 0, 255).astype(np.uint8)


def test_bands_of_light_that_wander_over_the_rows_do_not_lose_the_camera(box_room, box_walk):
    tracking, views = tracked(box_room, [banded(grey, 0.37 * i) for i, grey in enumerate(box_walk.grey)])
    assert len(views) == 60
    assert errors(tracking, views, dict(enumerate(box_walk.poses))).max() < 0.03


def test_the_camera_is_found_again_after_frames_of_nothing_but_blur(box_room, box_walk):
    kernel = np.full((81, 81), 1 / 81**2, np.float32)
    greys = [cv2.filter2D(grey, -1, kernel) if 30 <= i < 36 else grey for i, grey in enumerate(box_walk.grey)]
    tracking, views = tracked(box_room, greys)
    assert sorted(views) == [*range(30), *range(36, 60)]
    assert errors(tracking, views, {i: T for i, T in enumerate(box_walk.poses) if i in views}).max() < 0.02


def test_something_that_walks_through_the_picture_is_no_part_of_the_map(box_room, box_walk):
    """As wide as a third of the picture, with texture of its own."""
    walker = np.ascontiguousarray(box_walk.grey[0][:, 100:205][:, ::-1])
    greys = []
    for i, grey in enumerate(box_walk.grey):
        grey, left = grey.copy(), 8 * i - 150
        shown = slice(max(0, left), max(0, min(320, left + 105)))
        if shown.stop > shown.start:
            grey[:, shown] = walker[:, shown.start - left : shown.stop - left]
        greys.append(grey)
    tracking, views = tracked(box_room, greys)
    assert len(views) == 60
    assert errors(tracking, views, dict(enumerate(box_walk.poses))).max() < 0.03
