"""Matching pictures of known planes finds their depth where a map has it wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from pipelines.surface.joined_depth import joined_depth
from pipelines.surface.matched_depth import DepthMatcher, DepthView, choose_neighbours

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


def test_where_pictures_say_nothing_the_map_stands() -> None:
    seen, true = views(contrast=0.0)
    depth = DepthMatcher(seen).matched(4)
    assert error(depth, true[4]).max() < 0.01
    alone = seen[:1]
    np.testing.assert_array_equal(DepthMatcher(alone).matched(0), alone[0].depth)


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
