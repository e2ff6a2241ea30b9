"""The numbers behind the drawings, computed another way, and the view from above of worlds whose up is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modp_ti.outputs.report.plots import binned, floor_plan, frame_rate, plan_of, shifts_and_turns
from modp_ti.outputs.report.record import FrameNote
from tests.modp_ti.outputs.report.made_up_run import cameras


@pytest.mark.parametrize("count", [1, 2, 8])
def test_the_frame_rate_is_the_inverse_of_the_mean_duration_of_the_last_frames(count: int) -> None:
    durations = [0.25, 3.0, 1.0, 0.25, 0.25, 2.0, 0.5, 0.125][:count]
    done = np.cumsum(durations)
    rate, window = frame_rate([FrameNote(i, False, True, float(t), 0, None) for i, t in enumerate(done)], 3), 3
    window = min(window, count)  # of fewer frames, the rate of all
    expected = [1 / np.mean(durations[i + 1 - window : i + 1]) for i in range(window - 1, count)]
    np.testing.assert_allclose(rate, [*[np.nan] * (window - 1), *expected])


def test_few_values_are_left_alone_and_many_become_means_of_neighbours() -> None:
    x, y = np.arange(1.0, 5.0), np.array([4.0, np.nan, 2.0, 7.0])
    np.testing.assert_array_equal(binned(x, y, 10), ([1, 3, 4], [4, 2, 7]))
    x = np.arange(1000.0)
    at, mean = binned(x, 2 * x + 1, 10)
    np.testing.assert_allclose(at, np.arange(10) * 100 + 49.5)
    np.testing.assert_allclose(mean, 2 * at + 1)


def test_shifts_and_turns_are_those_of_the_cameras() -> None:
    rng = np.random.default_rng(3)
    before, after, shifts, turns = [], [], [], []
    for degrees in (0.0, 1e-5, 0.02, 3.0, 90.0, 180.0):
        R, turn = Rotation.random(random_state=rng), Rotation.from_rotvec([0, np.radians(degrees), 0])
        centre, shift = rng.normal(size=3), rng.normal(size=3)
        for poses, rotation, place in ((before, R, centre), (after, turn * R, centre + shift)):
            T = np.eye(4)
            T[:3, :3] = rotation.as_matrix()
            T[:3, 3] = -T[:3, :3] @ place
            poses.append(T)
        shifts.append(np.linalg.norm(shift))
        turns.append(degrees)
    found = shifts_and_turns(before, after)
    np.testing.assert_allclose(found[0], shifts, rtol=1e-9)
    np.testing.assert_allclose(found[1], turns, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("rotvec", [(0, 0, 0), (0.3, -1.2, 2.0)])
def test_up_is_where_the_cameras_were_held_up_and_distances_on_the_ground_are_kept(rotvec) -> None:
    R, world = Rotation.from_rotvec(rotvec).as_matrix(), np.eye(4)
    world[:3, :3] = R.T
    plan = plan_of([T @ world for T in cameras(20)])
    np.testing.assert_allclose(plan[2], R @ [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(np.cross(plan[0], plan[1]), plan[2], atol=1e-12)
    points = np.random.default_rng(0).normal(size=(30, 3))
    page = (points @ R.T) @ plan[:2].T
    ground = np.linalg.norm(points[:, None, :2] - points[None, :, :2], axis=2)
    np.testing.assert_allclose(np.linalg.norm(page[:, None] - page[None], axis=2), ground, atol=1e-12)


def test_the_first_camera_looks_up_the_page_and_the_way_runs_across_it() -> None:
    poses = cameras(20)
    for i, T in enumerate(poses):  # the circle drawn out to an ellipse along the world's y
        centre = -T[:3, :3].T @ T[:3, 3] * [1, 4, 1]
        poses[i] = np.vstack([np.hstack([T[:3, :3], -(T[:3, :3] @ centre)[:, None]]), [0, 0, 0, 1]])
    right, ahead, _ = plan_of(poses)
    assert poses[0][2, :3] @ ahead >= -1e-12
    assert abs(right[1]) == pytest.approx(1.0)


@pytest.mark.parametrize("heights", [[0], [0, 0, 0], [0, 1, 2, 3]])
def test_cameras_that_stand_still_or_move_straight_up_have_a_plan_too(heights: list[int]) -> None:
    poses = np.tile(np.eye(4), (len(heights), 1, 1))
    poses[:, 1, 3] = heights
    axes = plan_of(list(poses))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(axes[2], [0, -1, 0], atol=1e-9)


def test_the_floor_is_what_is_opaque_and_below_the_cameras_the_highest_on_top() -> None:
    poses = cameras(8, height=1.5)
    plan = plan_of(poses)
    position = np.array([[0, 0, 1.0], [1, 0, 0.0], [0, 1, 2.0], [2, 2, 0.5]], np.float32)
    logit = np.array([3.0, 3.0, 3.0, -3.0], np.float32)  # the last one is transparent, the third is the ceiling
    sh = np.zeros((4, 4, 3), np.float32)
    sh[0, 0], sh[1, 0] = [1.0, 0, 0], [0, 9.0, -9.0]
    centres = np.array([-T[:3, :3].T @ T[:3, 3] for T in poses])
    places, colours = floor_plan(plan, {"position": position, "opacity_logit": logit, "sh": sh}, centres)
    np.testing.assert_allclose(places, position[[1, 0]].astype(float) @ plan[:2].T, atol=1e-6)
    np.testing.assert_allclose(colours, [[0.5, 1, 0], [0.5 + 0.5 / np.sqrt(np.pi), 0.5, 0.5]], atol=1e-6)
