"""Matching pictures of known planes finds their depth where a map has it wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from modp_ti.outputs.formats.matched_depth import DepthView, agreed_depth, choose_neighbours, matched_depth

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
    depth = matched_depth(shown, 4, choose_neighbours(shown, 4))
    assert error(shown[4].depth, true[4]).min() > 0.05
    assert np.median(error(depth, true[4])) < 0.01
    assert (error(depth, true[4]) < 0.03).mean() > 0.9


def test_where_pictures_say_nothing_the_map_stands() -> None:
    seen, true = views(contrast=0.0)
    depth = matched_depth(seen, 4, choose_neighbours(seen, 4))
    assert error(depth, true[4]).max() < 0.01
    alone = seen[:1]
    np.testing.assert_array_equal(matched_depth(alone, 0, choose_neighbours(alone, 0)), alone[0].depth)


def test_neighbours_lie_on_both_sides_at_the_wanted_parallaxes() -> None:
    seen, _ = views(contrast=1.0)
    chosen = choose_neighbours(seen, 4)
    assert len(set(chosen)) == len(chosen) and 4 not in chosen
    assert min(chosen) < 4 < max(chosen)
    turned = replace(seen[5], T_camera_world=np.diag([-1.0, 1.0, -1.0, 1.0]) @ seen[5].T_camera_world)
    assert 5 not in choose_neighbours([*seen[:5], turned, *seen[6:]], 4)


def test_depth_is_kept_where_neighbours_agree_on_it() -> None:
    seen, _ = views(contrast=1.0)
    bent = seen[4].depth.copy()
    bent[:, :40] *= 1.03  # no neighbour agrees
    shown = [*seen[:4], replace(seen[4], depth=bent), *seen[5:]]
    depth = agreed_depth(shown, 4, [2, 3, 5, 6])
    assert (depth[:, :40] == 0).all()
    assert (depth[8:-8, 48:-8] == bent[8:-8, 48:-8]).all()


def test_a_view_that_nobody_agrees_with_keeps_all_its_depth() -> None:
    shown, _ = views(0.3)
    wrong = [replace(view, depth=view.depth * np.float32(1 + 0.1 * i)) for i, view in enumerate(shown)]
    assert (agreed_depth(wrong, 4, [2, 3, 5, 6]) == wrong[4].depth).all()
