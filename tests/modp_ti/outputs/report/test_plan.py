"""The view from above, of worlds whose up is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modp_ti.outputs.report.plots import floor_plan, plan_of
from tests.modp_ti.outputs.report.made_up_run import cameras


def turned(poses, R):
    """The same cameras in a world turned by R (3, 3)."""
    world = np.eye(4)
    world[:3, :3] = R.T
    return [T @ world for T in poses]


@pytest.mark.parametrize("rotvec", [(0, 0, 0), (0.3, -1.2, 2.0)])
def test_up_is_where_the_cameras_were_held_up_and_distances_on_the_ground_are_kept(rotvec) -> None:
    R = Rotation.from_rotvec(rotvec).as_matrix()
    plan = plan_of(turned(cameras(20), R))
    np.testing.assert_allclose(plan.up, R @ [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(np.cross(plan.right, plan.ahead), plan.up, atol=1e-12)
    points = np.random.default_rng(0).normal(size=(30, 3))
    page = plan.on_page(points @ R.T)
    ground = np.linalg.norm(points[:, None, :2] - points[None, :, :2], axis=2)
    np.testing.assert_allclose(np.linalg.norm(page[:, None] - page[None], axis=2), ground, atol=1e-12)


def test_the_first_camera_looks_up_the_page_and_the_way_runs_across_it() -> None:
    poses = cameras(20)
    for i, T in enumerate(poses):  # the circle drawn out to an ellipse along the world's y
        centre = -T[:3, :3].T @ T[:3, 3] * [1, 4, 1]
        poses[i] = np.vstack([np.hstack([T[:3, :3], -(T[:3, :3] @ centre)[:, None]]), [0, 0, 0, 1]])
    plan = plan_of(poses)
    assert poses[0][2, :3] @ plan.ahead >= -1e-12
    assert abs(plan.right[1]) == pytest.approx(1.0)


@pytest.mark.parametrize("poses", [[np.eye(4)], [np.eye(4)] * 3])
def test_cameras_that_do_not_move_have_a_plan_too(poses) -> None:
    plan = plan_of(poses)
    axes = np.stack([plan.right, plan.ahead, plan.up])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(plan.up, [0, -1, 0])


def test_a_camera_that_moves_straight_up_has_a_plan_too() -> None:
    poses = []
    for height in range(4):
        T = np.eye(4)
        T[1, 3] = height
        poses.append(T)
    plan = plan_of(poses)
    axes = np.stack([plan.right, plan.ahead, plan.up])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)


def test_the_floor_is_what_is_opaque_and_below_the_cameras_the_highest_on_top() -> None:
    poses = cameras(8, height=1.5)
    plan = plan_of(poses)
    position = np.array([[0, 0, 1.0], [1, 0, 0.0], [0, 1, 2.0], [2, 2, 0.5]], np.float32)
    logit = np.array([3.0, 3.0, 3.0, -3.0], np.float32)  # the last one is transparent, the third is the ceiling
    sh = np.zeros((4, 4, 3), np.float32)
    sh[0, 0], sh[1, 0] = [1.0, 0, 0], [0, 9.0, -9.0]
    centres = np.array([-T[:3, :3].T @ T[:3, 3] for T in poses])
    places, colours = floor_plan(plan, {"position": position, "opacity_logit": logit, "sh": sh}, centres)
    np.testing.assert_allclose(places, plan.on_page(position[[1, 0]].astype(float)), atol=1e-6)
    np.testing.assert_allclose(colours, [[0.5, 1, 0], [0.5 + 0.5 / np.sqrt(np.pi), 0.5, 0.5]], atol=1e-6)
