from __future__ import annotations

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from fields.geometry.pixel_metric import pixel_metric
from fields.geometry.se3 import exp_se3

CAMERA = PinholeCamera(40.0, 42.0, 21.0, 17.0, 43, 35)
DEPTH = 4.0


def test_a_unit_of_the_pixel_metric_moves_the_image_by_a_pixel() -> None:
    x, y = np.meshgrid((np.arange(5) + 0.5) / 5 * CAMERA.width, (np.arange(5) + 0.5) / 5 * CAMERA.height)
    pixels = np.tile(np.stack([x.ravel(), y.ravel()], axis=1), (2, 1))
    points = CAMERA.unproject(pixels, np.repeat([0.6 * DEPTH, 1.6 * DEPTH], 25))
    rng = np.random.default_rng(0)
    for _ in range(5):
        u = 1e-5 * rng.normal(size=6)
        T = exp_se3(pixel_metric(CAMERA, DEPTH) @ u)
        moved = CAMERA.project(points @ T[:3, :3].T + T[:3, 3]) - pixels
        assert np.sqrt((moved**2).sum(axis=1).mean()) == pytest.approx(np.linalg.norm(u), rel=1e-3)


def test_the_metric_follows_the_scale_of_the_scene() -> None:
    W, tenth = pixel_metric(CAMERA, DEPTH), pixel_metric(CAMERA, 0.1 * DEPTH)
    np.testing.assert_allclose(tenth[:3], 0.1 * W[:3], atol=1e-12)
    np.testing.assert_allclose(tenth[3:], W[3:], atol=1e-12)
