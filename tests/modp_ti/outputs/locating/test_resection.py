"""Poses from matches with points, among outliers, against the true ones."""

from __future__ import annotations

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3, inverse_se3, log_se3
from modp_ti.outputs.locating.resection import pose_covariance, resect
from tests.spread import disturbed

CAMERA = PinholeCamera(300.0, 300.0, 160.0, 120.0, 320, 240)
NOISE = 0.5


def matches(rng: np.random.Generator, count: int, wrong: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A pose T_camera_world, world points (N, 3), and their pixels (N, 2); the first `wrong` of them are anywhere."""
    T = exp_se3(rng.normal(size=6))
    pixels = rng.uniform([0, 0], [320, 240], (count, 2))
    p = CAMERA.unproject(pixels, rng.uniform(2, 6, count))
    pixels += rng.normal(0, NOISE, pixels.shape)
    pixels[:wrong] = rng.uniform([0, 0], [320, 240], (wrong, 2))
    T_world_camera = inverse_se3(T)
    return T, disturbed(p @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]), disturbed(pixels)


@pytest.mark.parametrize("focal", [300.0, 420.0])
def test_the_pose_and_an_unknown_focal_length_are_found_among_outliers(focal: float) -> None:
    guess = PinholeCamera(focal, focal, 160.0, 120.0, 320, 240)
    T, xyz, pixels = matches(np.random.default_rng(1), 300, 100 if focal != 300 else 200)
    found = resect(xyz, pixels, guess, 3.0, seed=0, estimate_focal=focal != 300)
    assert found is not None and found.camera.fx == found.camera.fy == pytest.approx(300.0, rel=0.01)
    assert found.inlier[200:].mean() > 0.95 and found.inlier[:100].mean() < 0.05
    assert np.abs(log_se3(found.T_camera_world @ inverse_se3(T))).max() < 0.05


def test_too_few_matches_give_no_pose() -> None:
    _, xyz, pixels = matches(np.random.default_rng(2), 3, 0)
    assert resect(xyz, pixels, CAMERA, 3.0, seed=0) is None


def test_the_covariance_is_that_of_the_errors() -> None:
    """Squared errors in units of the covariance have the mean 6 of a chi-squared distribution."""
    rng = np.random.default_rng(3)
    squares = []
    for _ in range(200):
        T, xyz, pixels = matches(rng, 60, 0)
        found = resect(xyz, pixels, CAMERA, 5.0, seed=0)
        assert found is not None
        error = log_se3(T @ inverse_se3(found.T_camera_world))
        squares.append(error @ np.linalg.solve(pose_covariance(found.T_camera_world, xyz, pixels, CAMERA), error))
    assert 4.5 < np.mean(squares) < 8.5
