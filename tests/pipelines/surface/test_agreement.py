"""Views agree on the depth of a pixel exactly where a plain projection says so."""

from __future__ import annotations

import numpy as np

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3
from pipelines.surface.agreement import Placed, agreeing_views

TOLERANCE = 0.02
CAMERA = PinholeCamera(60.0, 62.0, 34.0, 25.0, 70, 50)  # the width is no multiple of what the kernel works on at once


def wavy(camera: PinholeCamera, rng: np.random.Generator) -> np.ndarray:
    """Depths around 2 m that differ by some tolerances, with holes."""
    v, u = np.mgrid[: camera.height, : camera.width]
    depth = 2.0 + 0.06 * np.sin(u / rng.uniform(4, 9)) * np.cos(v / rng.uniform(4, 9))
    depth[rng.random(depth.shape) < 0.1] = 0.0
    return depth.astype(np.float32)


def plain_count(view: Placed, others: list[Placed]) -> tuple[np.ndarray, np.ndarray]:
    """The number of agreeing views (H, W), and where rounding may decide otherwise (H, W)."""
    camera, T, depth = view
    count, doubtful = np.zeros(depth.shape), np.zeros(depth.shape, dtype=bool)
    for y, x in zip(*np.nonzero(depth), strict=True):
        ray = np.array([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, 1.0])
        point = np.linalg.inv(T) @ np.append(float(depth[y, x]) * ray, 1.0)
        for other, T_other, there in others:
            p = T_other @ point
            if p[2] <= 0:
                continue
            place = np.array([other.fx * p[0] / p[2] + other.cx, other.fy * p[1] / p[2] + other.cy])
            doubtful[y, x] |= bool((np.abs(place - np.rint(place)) < 1e-3).any())
            u, v = np.floor(place).astype(int)
            if 0 <= u < other.width and 0 <= v < other.height and there[v, u] > 0:
                difference = abs(p[2] / there[v, u] - 1)
                doubtful[y, x] |= abs(difference - TOLERANCE) < 1e-4
                count[y, x] += difference < TOLERANCE
    return count, doubtful


def test_the_views_that_agree_are_those_of_a_plain_projection() -> None:
    rng = np.random.default_rng(0)
    small = PinholeCamera(40.0, 40.0, 20.0, 15.0, 40, 30)
    view = (CAMERA, np.eye(4), wavy(CAMERA, rng))
    behind = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0]))
    others = [
        (camera, exp_se3(rng.uniform(-0.1, 0.1, 6)) @ T, wavy(camera, rng))
        for camera, T in ((CAMERA, np.eye(4)), (small, np.eye(4)), (CAMERA, np.eye(4)), (CAMERA, behind))
    ]
    expected, doubtful = plain_count(view, others)
    assert doubtful.mean() < 0.1
    assert (np.bincount(expected[~doubtful].astype(int), minlength=3)[:3] > 100).all()
    np.testing.assert_array_equal(agreeing_views(view, others, TOLERANCE)[~doubtful], expected[~doubtful])
