"""The surface of a finished map: agreement, matching and planes, against plain projections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3
from pipelines.surface.depth import (
    DepthMatcher,
    DepthView,
    Placed,
    agreeing_views,
    choose_neighbours,
    fitted_plane,
    joined_depth,
    planes_of_plain_regions,
)

TOLERANCE = 0.02
UNEVEN = PinholeCamera(60.0, 62.0, 34.0, 25.0, 70, 50)  # the width is no multiple of what the kernel works on at once


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
    view = (UNEVEN, np.eye(4), wavy(UNEVEN, rng))
    behind = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0]))
    others = [
        (camera, exp_se3(rng.uniform(-0.1, 0.1, 6)) @ T, wavy(camera, rng))
        for camera, T in ((UNEVEN, np.eye(4)), (small, np.eye(4)), (UNEVEN, np.eye(4)), (UNEVEN, behind))
    ]
    expected, doubtful = plain_count(view, others)
    assert doubtful.mean() < 0.1
    assert (np.bincount(expected[~doubtful].astype(int), minlength=3)[:3] > 100).all()
    np.testing.assert_array_equal(agreeing_views(view, others, TOLERANCE)[~doubtful], expected[~doubtful])


CAMERA = PinholeCamera(100.0, 100.0, 64.0, 48.0, 128, 96)
NORMAL, OFFSET = np.array([0.3, -0.2, -1.0]), -2.5  # the plane NORMAL . X = OFFSET, 2 to 3.3 before the cameras


def views(contrast: float) -> tuple[list[DepthView], list[np.ndarray]]:
    """A plane with a smooth random pattern seen exactly by nine cameras beside each other, and its true depths."""
    rng = np.random.default_rng(0)
    waves, phases = rng.normal(0, 12, (40, 2)), rng.uniform(0, 2 * np.pi, 40)
    row, column = np.mgrid[:96, :128] + 0.5
    rays = np.stack([(column - 64.0) / 100.0, (row - 48.0) / 100.0, np.ones_like(row)], axis=2)
    seen, depths = [], []
    for x in np.linspace(-0.6, 0.6, 9):
        centre = np.array([x, 0.1 * x, 0.0])
        T = np.eye(4)
        T[:3, 3] = -centre
        z = (OFFSET - NORMAL @ centre) / (rays @ NORMAL)
        places = centre + rays * z[..., None]
        pattern = np.sin(places[..., :2] @ waves.T + phases).mean(axis=2)
        seen.append(DepthView(CAMERA, T, (0.5 + contrast * pattern).astype(np.float32), z.astype(np.float32)))
        depths.append(z)
    return seen, depths


def error(depth: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Relative errors of the pixels away from the border."""
    return np.abs(depth / true - 1)[8:-8, 8:-8]


@pytest.mark.parametrize("wrong", [0.94, 1.06])
def test_a_depth_that_is_wrong_everywhere_is_put_right(wrong: float) -> None:
    seen, true = views(contrast=1.0)
    shown = [replace(view, depth=view.depth * np.float32(wrong)) for view in seen]
    depth = DepthMatcher(shown).matched(4)
    assert error(shown[4].depth, true[4]).min() > 0.05
    assert np.median(error(depth, true[4])) < 0.01
    assert (error(depth, true[4]) < 0.03).mean() > 0.9


def test_the_background_right_beside_an_object_is_found_on_all_its_sides() -> None:
    """A square before a wall, seen by cameras above, below and beside each other, in a map in which it is too large."""
    rng = np.random.default_rng(0)
    waves, phases = rng.normal(0, 12, (40, 2)), rng.uniform(0, 2 * np.pi, 40)
    row, column = np.mgrid[:96, :128] + 0.5
    rays = np.stack([(column - 64.0) / 100.0, (row - 48.0) / 100.0], axis=2)
    reach = [-0.3, -0.2, -0.1, 0.1, 0.2, 0.3]
    seen = []
    for x, y in [(0.0, 0.0), *((step, 0.0) for step in reach), *((0.0, step) for step in reach)]:
        T = np.eye(4)
        T[:2, 3] = -x, -y
        is_square = (np.abs((x, y) + 2.0 * rays) < 0.4).all(axis=2)
        z = np.where(is_square, 2.0, 3.0)
        places = (x, y) + z[..., None] * rays + 5.0 * is_square[..., None]
        pattern = np.sin(places @ waves.T + phases).mean(axis=2)
        depth = np.where((np.abs((x, y) + 2.0 * rays) < 0.5).all(axis=2), 2.0, 3.0).astype(np.float32)
        seen.append(DepthView(CAMERA, T, (0.5 + pattern).astype(np.float32), depth))
    found = DepthMatcher(seen).matched(0)
    beside = (seen[0].depth == 2.0) & (np.abs(2.0 * rays).max(axis=2) > 0.44)
    for side in (rays[..., 0] < -0.2, rays[..., 0] > 0.2, rays[..., 1] < -0.2, rays[..., 1] > 0.2):
        assert (np.abs(found - 3.0) < 0.1)[beside & side].mean() > 0.9


def test_neighbours_lie_on_both_sides_at_the_wanted_parallaxes() -> None:
    seen, _ = views(contrast=1.0)
    chosen = choose_neighbours(seen, 4)
    assert len(set(chosen)) == len(chosen) and 4 not in chosen
    assert min(chosen) < 4 < max(chosen)
    turned = replace(seen[5], T_camera_world=np.diag([-1.0, 1.0, -1.0, 1.0]) @ seen[5].T_camera_world)
    assert 5 not in choose_neighbours([*seen[:5], turned, *seen[6:]], 4)


def test_each_pixel_takes_the_depth_that_the_neighbours_have() -> None:
    """Where matching is wrong the map's depth stands if the neighbours agree with it, and nothing where none does."""
    seen, _ = views(contrast=1.0)
    true = [view.depth for view in seen]
    wrong = true[4].copy()
    wrong[:, :40] *= 1.1
    shown = [replace(view, depth=view.depth.copy()) for view in seen]
    shown[4].depth[:48, :40] *= 1.2
    neighbours = [[2, 3, 5, 6]] * 9
    depth = next(joined_depth(shown, [*true[:4], wrong, *true[5:]], neighbours, [4]))
    inner = np.s_[8:-8, 48:-8]
    assert (depth[inner] == true[4][inner]).all()
    assert (depth[:48, 8:40] == 0).all()
    assert (depth[48:-8, 8:40] == true[4][48:-8, 8:40]).all()


def test_a_view_that_nobody_agrees_with_keeps_all_its_depth() -> None:
    shown, _ = views(0.3)
    wrong = [view.depth * np.float32(1 + 0.1 * i) for i, view in enumerate(shown)]
    depth = next(joined_depth(shown, wrong, [[2, 3, 5, 6]] * 9, [4]))
    assert (depth == wrong[4]).all()


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
