"""Regions without texture get the planes that bound them."""

from __future__ import annotations

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from pipelines.surface.planes import fitted_plane, planes_of_plain_regions

CAMERA = PinholeCamera(100.0, 100.0, 80.0, 60.0, 160, 120)
PLANE = np.array([0.002, -0.001, 0.5])  # inverse depth a x + b y + c


def wall(noise: float = 0.002) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grey image, true and measured inverse depth of a wall with a plain middle, where the measurement is wrong."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:120, :160]
    inverse = (PLANE[0] * column + PLANE[1] * row + PLANE[2]).astype(np.float32)
    grey = rng.uniform(0.2, 0.8, (120, 160)).astype(np.float32)
    measured = inverse * (1 + noise * rng.normal(size=inverse.shape)).astype(np.float32)
    middle = np.s_[30:90, 40:120]
    grey[middle] = 0.5
    measured[middle] *= 1.3
    return grey, inverse, measured


def test_the_inverse_depth_of_a_plane_is_linear() -> None:
    """The plane of points of a known wall is the one of its equation n . X = d: (n . ray) / d at each pixel."""
    normal, offset = np.array([0.3, -0.2, 1.0]), 2.5
    rng = np.random.default_rng(1)
    places = rng.uniform(0, [160, 120], (300, 2))
    rays = np.column_stack([(places[:, 0] - 80.0) / 100.0, (places[:, 1] - 60.0) / 100.0, np.ones(300)])
    inverse = rays @ normal / offset
    inverse[:90] *= rng.uniform(0.5, 1.5, 90)
    fit = fitted_plane(places, inverse, rng)
    assert fit is not None
    plane, on_it = fit
    a, b = normal[:2] / 100.0 / offset
    np.testing.assert_allclose(plane, [a, b, normal[2] / offset - 80.0 * a - 60.0 * b], rtol=1e-2)
    assert on_it[90:].all() and on_it[:90].mean() < 0.2


def test_points_of_no_plane_have_none() -> None:
    rng = np.random.default_rng(2)
    places = rng.uniform(0, 100, (200, 2))
    assert fitted_plane(places, rng.uniform(0.2, 1.0, 200), rng) is None
    assert fitted_plane(places[:2], np.ones(2), rng) is None


def test_a_plain_region_gets_the_plane_around_it() -> None:
    grey, inverse, measured = wall()
    trusted = grey != 0.5
    found = planes_of_plain_regions(grey, measured, trusted)
    inside = np.s_[33:87, 43:117]
    assert (found[inside] > 0).all()
    assert np.abs(found[inside] / inverse[inside] - 1).max() < 0.005
    assert (found[:25] == 0).all()  # textured


@pytest.mark.parametrize("side", ["left", "none"])
def test_a_region_whose_border_says_too_little_is_left_alone(side: str) -> None:
    grey, _, measured = wall()
    trusted = np.zeros_like(grey, bool)
    if side == "left":
        trusted[:, :40] = True
    assert (planes_of_plain_regions(grey, measured, trusted) == 0).all()
