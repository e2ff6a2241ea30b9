"""What floats before the surfaces of another map is found: against a plain twin, and on fog before a wall."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3, inverse_se3
from pipelines.render.renderer import Renderer
from pipelines.whole.free_space import BEFORE, FreeSpace, ShownSurface
from tests.pipelines import reference
from tests.pipelines.scenes import CAMERA, NEAR, POSE, random_gaussians

State = dict[str, NDArray[np.float64]]
SIZE = (CAMERA.height, CAMERA.width)


def shown(state: State, view: ShownSurface) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums (N,) of alpha T and of alpha T z / D over the pixels with a surface, by the plain renderer."""
    splats = reference.project(state, CAMERA, view.T_camera_world, NEAR)
    weight, weighted_ratio = np.zeros(len(state["position"])), np.zeros(len(state["position"]))
    T, surface = np.ones(SIZE), view.depth > 0
    for i, alpha in zip(splats.index, splats.alpha(CAMERA.width, CAMERA.height), strict=True):
        drawn = np.where(alpha >= reference.ALPHA_MIN, np.minimum(alpha, reference.ALPHA_MAX), 0.0)
        z = state["position"][i] @ view.T_camera_world[2, :3] + view.T_camera_world[2, 3]
        weight[i] = (drawn * T)[surface].sum()
        weighted_ratio[i] = (drawn * T * z)[surface] @ (1.0 / view.depth[surface])
        T = T * (1 - drawn)
    return weight, weighted_ratio


@pytest.mark.parametrize("seed", range(3))
def test_the_rule_is_that_of_the_plain_twin(renderers: Callable[..., Renderer], seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, numbers = random_gaussians(150, seed), rng.integers(0, 3, 150)
    views = []
    for number in range(3):
        depth = np.where(rng.random(SIZE) < 0.2, 0.0, rng.uniform(3.0, 6.0, SIZE))
        pose = exp_se3(0.1 * rng.normal(size=6)) @ POSE
        views.append(ShownSurface(number, CAMERA, pose, depth))
    before, elsewhere, unsure = np.zeros(150), np.zeros(150), np.zeros(150, dtype=bool)
    for view in views:
        weight, weighted_ratio = shown(state, view)
        is_before = (weighted_ratio < BEFORE * weight) & (numbers != view.number)
        before += np.where(is_before, weight, 0.0)
        elsewhere += np.where(is_before, 0.0, weight)
        unsure |= np.abs(weighted_ratio - BEFORE * weight) < 1e-3 * weight
    unsure |= np.abs(before - elsewhere) < 1e-3 * (before + elsewhere)
    renderer = renderers()
    renderer.gaussians.load(state)
    floating = FreeSpace(renderer, NEAR).floating(numbers, views)
    np.testing.assert_array_equal(floating[~unsure], (before > elsewhere)[~unsure])
    assert unsure.sum() < 10
    assert 20 < floating.sum() < 130


def wall_and_fog() -> State:
    """An opaque wall of 400 small Gaussians, four before the camera, and a large transparent one half-way to it."""
    across, down = np.meshgrid(np.linspace(0, CAMERA.width, 20), np.linspace(0, CAMERA.height, 20))
    pixels = np.append(np.column_stack([across.ravel(), down.ravel()]), [[20.0, 15.0]], axis=0)
    z = np.append(np.full(400, 4.0), 2.0)
    T_world_camera = inverse_se3(POSE)
    return {
        "position": CAMERA.unproject(pixels, z) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3],
        "log_scale": np.log(np.append(np.full((400, 3), 0.15), [[0.5, 0.5, 0.5]], axis=0)),
        "quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (401, 1)),
        "opacity_logit": np.append(np.full(400, 3.0), -1.0),
        "sh": np.zeros((401, 1, 3)),
    }


@pytest.mark.parametrize("of_fog", [0, 1])
def test_fog_before_a_wall_floats_unless_the_map_that_shows_the_wall_has_it(
    renderers: Callable[..., Renderer], of_fog: int
) -> None:
    renderer, state = renderers(), wall_and_fog()
    space = FreeSpace(renderer, NEAR)
    renderer.gaussians.load({name: values[:400] for name, values in state.items()})
    renderer.forward(CAMERA, POSE, NEAR)
    surface = space.surface(0, CAMERA, POSE)
    assert 3.5 < np.median(surface.depth) < 4.1
    renderer.gaussians.load(state)
    floating = space.floating(np.append(np.zeros(400, dtype=int), of_fog), [surface])
    assert not floating[:400].any()
    assert floating[400] == (of_fog == 1)


def test_what_another_map_does_not_see_does_not_float(renderers: Callable[..., Renderer]) -> None:
    renderer, state = renderers(), wall_and_fog()
    renderer.gaussians.load(state)
    nothing = ShownSurface(0, CAMERA, POSE, np.zeros(SIZE))
    away = ShownSurface(0, CAMERA, exp_se3([0.0, 0.0, 0.0, 0.0, np.pi, 0.0]) @ POSE, np.full(SIZE, 4.0))
    assert not FreeSpace(renderer, NEAR).floating(np.ones(401, dtype=int), [nothing, away]).any()
