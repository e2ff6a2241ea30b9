from __future__ import annotations

import numpy as np
import pytest
import torch

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.keyframes import KeyframeStore
from pipelines.densify.depth.gaussian_process import conditioning_points, regress_log_depth

CAMERA = PinholeCamera(50.0, 50.0, 32.0, 24.0, 64, 48)


def test_no_more_points_than_allowed_are_drawn_and_fewer_are_all_taken() -> None:
    rng = np.random.default_rng(0)
    pixels = rng.uniform([0, 0], [64, 48], (40, 2))
    depth = np.arange(1.0, 41.0)
    points = SparsePoints(CAMERA.unproject(pixels, depth), pixels, np.arange(40))
    image = np.zeros((48, 64, 3), dtype=np.float32)
    view = KeyframeStore().append(TrackedFrame(0, 0.0, "v", image, CAMERA, np.eye(4), points))
    places, z = conditioning_points(view, 40, rng)
    np.testing.assert_array_equal(places, pixels)
    np.testing.assert_allclose(z, depth)
    draws = [conditioning_points(view, 15, rng) for _ in range(2)]
    for places, z in draws:
        assert len(set(z)) == 15
        np.testing.assert_array_equal(places, pixels[np.round(z).astype(int) - 1])
    assert not np.array_equal(draws[0][1], draws[1][1])


def test_the_conditional_is_that_of_the_joint_gaussian() -> None:
    """Against the precision matrix of all places at once, the other way to condition."""
    rng = np.random.default_rng(1)
    A = rng.normal(size=(9, 9))
    joint = A @ A.T + np.eye(9)
    depth = np.exp(rng.normal(size=6))
    noise = 0.3
    estimate = regress_log_depth(
        depth,
        torch.from_numpy(joint[:6, :6]),
        noise,
        torch.from_numpy(joint[6:, :6]),
        torch.from_numpy(np.diag(joint)[6:].copy()),
    )
    observed = joint + np.diag([noise] * 6 + [0.0] * 3)
    precision = np.linalg.inv(observed)
    covariance = np.linalg.inv(precision[6:, 6:])
    y = np.log(depth)
    mean = y.mean() - covariance @ precision[6:, :6] @ (y - y.mean())
    np.testing.assert_allclose(estimate.depth, np.exp(mean), rtol=1e-10)
    np.testing.assert_allclose(estimate.deviation, np.sqrt(np.diag(covariance)), rtol=1e-10)


def test_a_place_that_is_known_exactly_has_no_deviation() -> None:
    K = torch.eye(3, dtype=torch.float64)
    estimate = regress_log_depth(np.array([1.0, 2.0, 4.0]), K, 0.0, K, 1.0)
    np.testing.assert_allclose(estimate.depth, [1.0, 2.0, 4.0])
    assert estimate.deviation == pytest.approx(0.0, abs=1e-7)
