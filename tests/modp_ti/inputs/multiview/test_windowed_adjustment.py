"""Bundle adjustment in NumPy, compared with the truth, with Ceres, and with finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fields.geometry.se3 import exp_se3, log_se3
from modp_ti.files.quiet_pycolmap import pycolmap
from modp_ti.inputs.multiview.bundle_adjustment import adjusted_bundle
from modp_ti.inputs.multiview.windowed_adjustment import Window, adjusted_window

FOCAL = 500.0


def scene(noise: float = 0.0, wrong: int = 0) -> tuple[Window, Window]:
    """Seven views of 120 points, four of them free, each point in some of the views: disturbed, and the true ones."""
    rng = np.random.default_rng(1)
    xyz = np.c_[rng.uniform(-2, 2, (120, 2)), rng.uniform(4, 8, 120)]
    poses = np.array([exp_se3([-0.25 * i, 0.04 * i * i, 0.02 * i, 0.01 * i, 0.02 * i, -0.01 * i]) for i in range(7)])
    sees = rng.random((7, 120)) < 0.7
    sees[:2] = True
    view, point = np.nonzero(sees)
    p = np.einsum("mij,mj->mi", poses[view, :3, :3], xyz[point]) + poses[view, :3, 3]
    rays = p[:, :2] / p[:, 2:] + noise / FOCAL * rng.standard_normal((len(view), 2))
    rays[rng.choice(len(view), wrong, replace=False)] += 25.0 / FOCAL
    truth = Window(poses, np.array([1, 3, 5, 6]), xyz, view, point, rays, 1.0 / FOCAL)
    start = poses.copy()
    for k in truth.free:
        start[k] = exp_se3(0.01 * rng.standard_normal(6)) @ poses[k]
    return replace(truth, poses=start, xyz=xyz + 0.03 * rng.standard_normal(xyz.shape)), truth


def robust_cost(window: Window) -> float:
    """Mean Cauchy loss, written out."""
    total = 0.0
    for k, i, ray in zip(window.view, window.point, window.rays, strict=True):
        p = window.poses[k, :3, :3] @ window.xyz[i] + window.poses[k, :3, 3]
        total += 0.5 * np.log(1.0 + ((p[:2] / p[2] - ray) ** 2).sum() / window.sigma**2)
    return total / len(window.view)


def test_exact_observations_lead_to_the_true_scene_and_fixed_views_stay():
    start, truth = scene()
    poses, xyz, cost = adjusted_window(start, 30)
    assert cost < 1e-6
    np.testing.assert_allclose(poses, truth.poses, atol=1e-4)
    np.testing.assert_allclose(xyz, truth.xyz, atol=1e-3)
    fixed = np.setdiff1d(np.arange(7), start.free)
    np.testing.assert_array_equal(poses[fixed], start.poses[fixed])


def test_it_ends_where_ceres_ends():
    start, _ = scene(noise=0.7, wrong=40)
    poses, xyz, cost = adjusted_window(start, 30)
    assert cost == pytest.approx(robust_cost(replace(start, poses=poses, xyz=xyz)), rel=1e-9)
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", width=1000, height=1000, params=[FOCAL, 0.0, 0.0])
    views, pixels = dict(enumerate(start.poses)), FOCAL * start.rays
    free = set(start.free.tolist())
    bundle = adjusted_bundle(camera, views, start.view, start.point, pixels, start.xyz, free, 60)
    assert bundle is not None
    assert cost == pytest.approx(bundle.cost, rel=1e-3)
    for k, T in bundle.poses.items():
        away = log_se3(poses[k] @ np.linalg.inv(T))
        assert np.abs(away).max() < 1e-3, "a tenth of the poses' uncertainty"


def test_its_end_is_a_minimum():
    start, _ = scene(noise=0.7, wrong=40)
    poses, xyz, _ = adjusted_window(start, 60)
    found = replace(start, poses=poses, xyz=xyz)
    least = robust_cost(found)
    for k in start.free:
        for direction in np.r_[np.eye(6), -np.eye(6)]:
            moved = poses.copy()
            moved[k] = exp_se3(2e-3 * direction) @ poses[k]
            assert robust_cost(replace(found, poses=moved)) > least


def test_points_behind_a_camera_do_no_harm():
    start, truth = scene()
    xyz = start.xyz.copy()
    xyz[:3, 2] = -5.0
    poses, found, _ = adjusted_window(replace(start, xyz=xyz), 40)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(poses, truth.poses, atol=1e-3)
