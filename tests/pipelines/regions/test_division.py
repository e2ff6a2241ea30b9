"""Regions hold every Gaussian once, and know which views see them and what else these views see."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from pipelines.regions.division import Eye, Region, regions

CAMERA = PinholeCamera(60.0, 60.0, 40.0, 30.0, 80, 60)
COUNT = 4000


@pytest.fixture(scope="module")
def gaussians() -> dict[str, NDArray]:
    """Small Gaussians on a wall at z = 2, which is 8 long and 2 high."""
    rng = np.random.default_rng(5)
    position = np.column_stack([rng.uniform(-4, 4, COUNT), rng.uniform(-1, 1, COUNT), np.full(COUNT, 2.0)])
    return {"position": position.astype(np.float32), "log_scale": np.full((COUNT, 3), np.log(0.01), np.float32)}


def eyes() -> list[Eye]:
    """A camera that moves along the wall, and one that looks away from it."""
    poses = []
    for x in np.linspace(-3.5, 3.5, 15):
        T = np.eye(4)
        T[0, 3] = -x
        poses.append(T)
    away = np.diag([-1.0, 1.0, -1.0, 1.0])
    return [Eye(CAMERA, T) for T in [*poses, away]]


def shown(gaussians: dict[str, NDArray], eye: Eye) -> NDArray[np.bool_]:
    """Whether the centre of each Gaussian is in the image."""
    local = gaussians["position"] @ eye.T_camera_world[:3, :3].T + eye.T_camera_world[:3, 3]
    ahead = local[:, 2] > 0
    return ahead & CAMERA.contains(CAMERA.project(np.where(ahead[:, None], local, [0.0, 0.0, 1.0])))


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_every_gaussian_belongs_to_one_of_the_regions_of_about_the_same_size(gaussians, count: int) -> None:
    parts = regions(gaussians, eyes(), 2.0, count)
    assert len(parts) == count
    np.testing.assert_array_equal(np.sort(np.concatenate([part.own for part in parts])), np.arange(COUNT))
    for part in parts:
        assert len(part.own) == pytest.approx(COUNT / count, rel=0.25)
        assert len(np.intersect1d(part.own, part.around)) == 0
    assert sum(part.load for part in parts) == pytest.approx(15.0), "one for each view that sees something"


def test_a_region_has_what_its_views_see_and_no_view_that_does_not_see_it(gaussians) -> None:
    for part in regions(gaussians, eyes(), 2.0, 4):
        there = np.concatenate([part.own, part.around])
        for place, eye in enumerate(eyes()):
            seen = np.flatnonzero(shown(gaussians, eye))
            if place in part.views:
                assert np.isin(seen, there).all()
            else:
                assert not np.isin(seen, part.own).any()
        assert len(part.views) < 12, "no view sees half of the wall"
        assert 15 not in part.views, "it looks away"


def border(part: Region, gaussians: dict[str, NDArray]) -> tuple[float, float]:
    """Lowest and highest x of a region."""
    x = gaussians["position"][part.own, 0]
    return float(x.min()), float(x.max())


def test_regions_are_cut_along_the_wall_and_borders_change_from_turn_to_turn(gaussians) -> None:
    first, second = (regions(gaussians, eyes(), 2.0, 2, turn) for turn in (0, 1))
    assert border(first[0], gaussians)[1] == pytest.approx(border(first[1], gaussians)[0], abs=0.3)
    assert border(first[0], gaussians)[1] == pytest.approx(0.0, abs=0.3)
    # The second cut is across the height, so each half is as long as the wall.
    for part in second:
        assert np.ptp(border(part, gaussians)) > 7.5
    again = regions(gaussians, eyes(), 2.0, 2, 2)
    np.testing.assert_array_equal(again[0].own, first[0].own)


def test_a_map_of_one_block_is_one_region() -> None:
    one = {"position": np.full((3, 3), 1.9, np.float32), "log_scale": np.full((3, 3), -6.0, np.float32)}
    (part,) = regions(one, eyes(), 20.0, 4)
    np.testing.assert_array_equal(part.own, [0, 1, 2])
