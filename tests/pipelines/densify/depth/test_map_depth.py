from __future__ import annotations

import numpy as np
import pytest

from fields.map.keyframes import KeyframeStore
from pipelines.densify.depth import MapDepth
from pipelines.render.renderer import Renderer
from tests.pipelines.wall import frame, on_the_plane, pose

VIEW = 2


@pytest.fixture
def wall(renderer: Renderer) -> Renderer:
    """A map of the left three quarters of the wall: a Gaussian a pixel of view 2."""
    x, y = np.meshgrid(np.arange(-4, 48) + 0.5, np.arange(-4, 52) + 0.5)
    xyz = on_the_plane(np.stack([x.ravel(), y.ravel()], axis=1), pose(VIEW))
    n = len(xyz)
    renderer.gaussians.load(
        {
            "position": xyz,
            "log_scale": np.full((n, 3), np.log(0.04)),
            "quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
            "opacity_logit": np.full(n, 4.0),
            "sh": np.zeros((n, 1, 3)),
        }
    )
    return renderer


def estimate(renderer: Renderer, pixels: np.ndarray, **change: float):
    view = KeyframeStore().append(frame(VIEW))
    return MapDepth(renderer, 0.01).estimate(view, [], pixels)


def test_the_depth_of_the_wall_is_known_where_the_map_is(wall: Renderer) -> None:
    x, y = np.meshgrid(np.arange(4.5, 40), np.arange(4.5, 44))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    found = estimate(wall, pixels)
    T = pose(VIEW)
    truth = on_the_plane(pixels, T) @ T[2, :3] + T[2, 3]
    assert (found.deviation < 0.06).all()
    np.testing.assert_allclose(found.depth, truth, rtol=0.02)


def test_a_hole_and_its_rim_are_not_trusted(wall: Renderer) -> None:
    pixels = np.array([[60.5, 20.5], [48.5, 20.5]])
    assert (estimate(wall, pixels).deviation > 1.0).all()


def test_the_deviation_is_how_far_the_map_is_from_the_tracked_points(wall: Renderer) -> None:
    state = wall.gaussians.to_numpy()
    T = pose(VIEW)
    centre = -T[:3, :3].T @ T[:3, 3]
    state["position"] = centre + 1.1 * (state["position"] - centre)  # ten percent too far
    state["log_scale"] += np.log(1.1)
    wall.gaussians.load(state)
    found = estimate(wall, np.array([[20.5, 20.5], [30.5, 30.5]]))
    assert (found.deviation > np.log(1.1)).all()
    assert (found.deviation < 2 * MapDepth.CAUTION * np.log(1.1)).all()


def test_an_empty_map_knows_nothing(renderer: Renderer) -> None:
    renderer.gaussians.remove(np.zeros(len(renderer.gaussians), dtype=bool))
    assert np.isinf(estimate(renderer, np.array([[20.5, 20.5]])).deviation).all()
