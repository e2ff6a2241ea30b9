from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.se3 import exp_se3
from fields.map.keyframes import KeyframeStore
from fields.runtime.engine import ti
from pipelines.optimise.map_optimiser import MapOptimiser
from pipelines.render.renderer import Renderer
from pipelines.settings import MappingSettings
from tests.pipelines.differences import STEP, central_differences
from tests.pipelines.scenes import CAMERA, POSE, random_gaussians

SETTINGS = MappingSettings(near=0.01, optimise={"aspect_weight": 0.0, "batch": 6})
WEIGHT = 0.2
MOTION = [0.2, -0.1, 0.1, 0.02, 0.05, -0.03]


def store_of_views(poses: list[NDArray], seed: int = 0) -> KeyframeStore:
    """Keyframes with random images, each with a masked rectangle."""
    rng = np.random.default_rng(seed)
    store = KeyframeStore()
    for index, pose in enumerate(poses):
        image = np.kron(rng.random((7, 9, 3)), np.ones((5, 5, 1)))[: CAMERA.height, : CAMERA.width]
        mask = np.ones(image.shape[:2], dtype=bool)
        mask[5:15, 20 + index : 35] = False
        points = SparsePoints(
            pose[:3, :3].T @ ([0, 0, 4.0] - pose[:3, 3]) * np.ones((1, 1)), np.ones((1, 2)), np.zeros(1)
        )
        store.append(TrackedFrame(index, 0.0, f"{index}", image.astype(np.float32), CAMERA, pose, points, mask))
    return store


# ---- the gradient of all that a step minimises ----------------------------------------------------------------


@pytest.fixture
def exact(renderers: Callable[..., Renderer]) -> Iterator[MapOptimiser]:
    """In float64, before a coloured background."""
    renderer = renderers(0, ti.f64)
    renderer.images.background[None] = ti.Vector([0.3, 0.1, 0.6])
    yield MapOptimiser(renderer.gaussians, renderer, SETTINGS)
    renderer.images.background[None] = ti.Vector([0.0, 0.0, 0.0])


def loss_of(optimiser: MapOptimiser, store: KeyframeStore, state: dict[str, NDArray], pose: NDArray) -> float:
    optimiser.gaussians.load(state)
    store[0].T_camera_world = pose
    values = optimiser.compare(store[0], store.scene_depth)
    return (1 - WEIGHT) * values.l1 + WEIGHT * (1 - values.ssim)


@pytest.mark.slow
def test_gradients_of_the_photometric_loss_are_those_of_finite_differences(exact: MapOptimiser) -> None:
    """Through loss, compositing and projection, with masked pixels, clamped ones, several tiles and small Gaussians.

    A picture jumps by up to 1/255 where a pixel crosses the cut of alpha. With steps of 1e-6 none does in this scene,
    or one of the bounds below would be missed by orders of magnitude.
    """
    store = store_of_views([POSE])
    state = random_gaussians(14, seed=31, size=(1.5, 9.0), logit=(-1.0, 6.0))
    loss_of(exact, store, state, POSE)
    exact.loss.backward(WEIGHT)
    exact.renderer.backward()
    gradients, camera = exact.gaussians.gradients_to_numpy(), exact.renderer.camera_gradient()
    for name, analytic in gradients.items():
        numeric = central_differences(lambda moved: loss_of(exact, store, moved, POSE), state, name)
        assert np.abs(analytic - numeric).max() < 1e-4 * np.abs(numeric).max(), name
    numeric = np.zeros(6)
    for k in range(6):
        xi = STEP * np.eye(6)[k]
        values = [loss_of(exact, store, state, exp_se3(sign * xi) @ POSE) for sign in (1, -1)]
        numeric[k] = (values[0] - values[1]) / (2 * STEP)
    assert np.abs(camera - numeric).max() < 1e-4 * np.abs(numeric).max()


# ---- a step ---------------------------------------------------------------------------------------------------


@pytest.fixture
def optimiser(renderers: Callable[..., Renderer]) -> MapOptimiser:
    renderer = renderers(0, ti.f32)
    renderer.gaussians.load(random_gaussians(200, seed=32, size=(1.5, 5.0)))
    return MapOptimiser(renderer.gaussians, renderer, SETTINGS)


@pytest.fixture
def store() -> KeyframeStore:
    return store_of_views([POSE, exp_se3(MOTION) @ POSE, exp_se3(-np.array(MOTION)) @ POSE])


def test_a_step_follows_the_mean_gradient_of_its_views(
    optimiser: MapOptimiser, store: KeyframeStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    gradients = []

    def instead_of_adam(*_: object, **__: object) -> None:
        gradients.append(optimiser.gaussians.gradients_to_numpy())
        optimiser.gaussians.load(optimiser.gaussians.to_numpy())  # back to no gradients

    monkeypatch.setattr(optimiser.adam, "step", instead_of_adam)
    for views in ([0], [1], [0, 1], [0, 0, 0, 1]):
        optimiser.step(store, views, optimiser.rates(1.0), pose_rate=0.0)
    for name, first in gradients[0].items():
        size = np.abs(first).max()
        assert size > 0
        np.testing.assert_allclose(gradients[2][name], (first + gradients[1][name]) / 2, atol=1e-4 * size)
        np.testing.assert_allclose(gradients[3][name], (3 * first + gradients[1][name]) / 4, atol=1e-4 * size)


def test_poses_move_only_where_asked_and_the_first_never(optimiser: MapOptimiser, store: KeyframeStore) -> None:
    before = [view.T_camera_world.copy() for view in store]
    tracked = store[2].T_tracked.copy()
    optimiser.step(store, [0, 1, 2], optimiser.rates(1.0), pose_rate=0.0)
    for view, pose in zip(store, before, strict=True):
        np.testing.assert_array_equal(view.T_camera_world, pose)
    optimiser.step(store, [0, 2, 2], optimiser.rates(1.0), pose_rate=0.03)
    np.testing.assert_array_equal(store[0].T_camera_world, before[0])
    np.testing.assert_array_equal(store[1].T_camera_world, before[1])
    assert np.abs(store[2].T_camera_world - before[2]).max() > 1e-5
    assert optimiser.poses.moments.steps[store[2].index] == 1  # drawn twice, stepped once
    np.testing.assert_array_equal(store[2].T_tracked, tracked)


def test_the_pose_of_the_first_keyframe_of_a_place_is_fixed(optimiser: MapOptimiser, store: KeyframeStore) -> None:
    store.begins.add(store[1].index)
    before = [view.T_camera_world for view in store]
    views = list(range(len(store)))
    optimiser.step(store, views, optimiser.rates(store.scene_depth), pose_rate=0.1)
    optimiser.settle()
    moved = [not np.array_equal(view.T_camera_world, T) for view, T in zip(store, before, strict=True)]
    assert moved == [False, False, *[True] * (len(store) - 2)]


def test_steps_bring_the_render_to_the_image(optimiser: MapOptimiser, store: KeyframeStore) -> None:
    before = optimiser.compare(store[0], store.scene_depth)
    rates = optimiser.rates(store.scene_depth)
    for _ in range(60):
        optimiser.step(store, [0], rates, pose_rate=0.0)
    after = optimiser.compare(store[0], store.scene_depth)
    assert after.psnr > before.psnr + 1.5
    assert after.ssim > before.ssim + 0.1
