from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3, matrix_from_quaternion
from fields.map.gaussians import GaussianField
from fields.runtime.engine import ti
from pipelines.densify.adaptive_density import AdaptiveDensity, GradientStatistics
from pipelines.render.renderer import Renderer
from pipelines.settings import OfflineSettings
from tests.pipelines.scenes import CAMERA, NEAR, POSE, random_gaussians

pytestmark = pytest.mark.slow

SETTINGS = OfflineSettings()
EXTENT = 3.0
N = 60


# ---- statistics ----------------------------------------------------------------------------------------------


def image_gradient(renderer: Renderer, weights: NDArray) -> NDArray[np.float64]:
    """d loss / d mean (slots, 2) in pixels by central differences, loss = <weights, colour>."""
    step = 1e-6
    gradient = np.zeros((renderer.projected.count, 2))
    for s in range(len(gradient)):
        mean = renderer.projected.mean[s].to_numpy()
        for axis in range(2):
            losses = []
            for sign in (1, -1):
                renderer.projected.mean[s] = mean + sign * step * np.eye(2)[axis]
                renderer.compositing.forward()
                losses.append((weights * renderer.images.colour_to_numpy()).sum())
            gradient[s, axis] = (losses[0] - losses[1]) / (2 * step)
        renderer.projected.mean[s] = mean
    return gradient


def test_statistics_are_the_mean_over_views_of_the_image_gradient(renderers: Callable[..., Renderer]) -> None:
    renderer = renderers(0, ti.f64)
    renderer.gaussians.load(random_gaussians(12, seed=4, beyond=0.6))
    statistics = GradientStatistics(renderer.gaussians.capacity, ti.f64)
    rng = np.random.default_rng(5)
    total, views = np.zeros(12), np.zeros(12)
    for pose in (POSE, exp_se3([1.2, 0.1, 0.0, 0.0, 0.1, 0.0]) @ POSE):
        renderer.forward(CAMERA, pose, NEAR)
        weights = rng.normal(size=(CAMERA.height, CAMERA.width, 3))
        nothing = np.zeros(weights.shape[:2])
        renderer.images.set_gradients(weights, nothing, nothing)
        renderer.compositing.backward()
        statistics.observe(renderer.projected, renderer.view)
        seen = [renderer.projected.gaussian[s] for s in range(renderer.projected.count)]
        half_image = [CAMERA.width / 2, CAMERA.height / 2]
        total[seen] += np.linalg.norm(image_gradient(renderer, weights) * half_image, axis=1)
        views[seen] += 1
    assert len(set(views)) > 1  # some are seen more often than others
    np.testing.assert_allclose(statistics.mean(12), total / np.maximum(views, 1), rtol=1e-4, atol=1e-4)
    statistics.clear()
    assert (statistics.mean(12) == 0).all()


# ---- rules ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pool(taichi_on_the_cpu: None) -> GaussianField:
    return GaussianField(1, max_gaussians=1024)


def filled(pool: GaussianField, gradients: NDArray, seed: int = 2, **changes: object) -> AdaptiveDensity:
    """The pool with random Gaussians of all kinds, whose mean gradients are given."""
    n = len(gradients)
    rng = np.random.default_rng(1)
    state = {
        "position": rng.normal(size=(n, 3)),
        "log_scale": np.log(EXTENT * np.exp(rng.uniform(np.log(0.002), np.log(0.3), (n, 1)) + rng.normal(size=(n, 3)))),
        "quaternion": rng.normal(size=(n, 4)),
        "opacity_logit": rng.uniform(-7, 3, n),
        "sh": rng.normal(size=(n, 4, 3)),
    }
    pool.load(state)
    pool.steps.fill(9)
    density = AdaptiveDensity(pool, SETTINGS.model_copy(update=changes), np.random.default_rng(seed))
    views = np.zeros(pool.capacity, dtype=np.int32)
    views[:n] = 4
    sums = np.zeros(pool.capacity, dtype=np.float32)
    sums[:n] = 4 * gradients
    density.statistics.views.from_numpy(views)
    density.statistics.gradient.from_numpy(sums)
    return density


def plain_round(state: dict[str, NDArray], gradients: NDArray, seed: int, prune_large: bool) -> list[NDArray]:
    """The rules of 3DGS, one Gaussian at a time: rows of all values, survivors before new ones."""
    survivors, copies, parents = [], [], []
    for i in range(len(gradients)):
        g = {name: value[i].astype(np.float64) for name, value in state.items()}
        longest = np.exp(g["log_scale"]).max()
        if gradients[i] >= 2e-4 and longest > 0.01 * EXTENT:
            parents.append(g)
            continue
        survivors.append(g)
        if gradients[i] >= 2e-4:
            copies.append(g)
    rng = np.random.default_rng(seed)
    children = []
    for _ in range(2):
        for g in parents:
            offset = matrix_from_quaternion(g["quaternion"]) @ (np.exp(g["log_scale"]) * rng.standard_normal(3))
            smaller = np.log(np.exp(g["log_scale"]) / 1.6)
            children.append(g | {"position": g["position"] + offset, "log_scale": smaller})
    kept = []
    for g in survivors + copies + children:
        opaque = 1 / (1 + np.exp(-g["opacity_logit"])) >= 0.005
        if opaque and not (prune_large and np.exp(g["log_scale"]).max() > 0.1 * EXTENT):
            kept.append(np.concatenate([np.atleast_1d(g[name]).ravel() for name in state]))
    return kept


def in_order(rows: NDArray) -> NDArray:
    return rows[np.lexsort(np.round(rows[:, :3], 3).T)]


@pytest.mark.parametrize("prune_large", [False, True])
def test_a_round_is_that_of_the_plain_rules(pool: GaussianField, prune_large: bool) -> None:
    n = 4 * N  # with N, a rule found one Gaussian in some draws
    gradients = np.random.default_rng(3).uniform(0, 4e-4, n).astype(np.float32)
    density = filled(pool, gradients, seed=8)
    before = pool.to_numpy()
    expected = np.array(plain_round(before, gradients, 8, prune_large))
    done = density.adapt(EXTENT, prune_large)
    after = pool.to_numpy()
    rows = np.concatenate([value.reshape(len(pool), -1) for value in after.values()], axis=1)
    np.testing.assert_allclose(in_order(rows), in_order(expected), rtol=1e-4, atol=1e-5)
    assert min(done) > 0  # every rule was at work
    assert len(pool) == n + done.cloned + done.split - done.pruned
    assert (density.statistics.mean(len(pool)) == 0).all()


def test_new_gaussians_have_no_history_and_the_others_keep_theirs(pool: GaussianField) -> None:
    gradients = np.random.default_rng(3).uniform(0, 4e-4, N).astype(np.float32)
    density = filled(pool, gradients, prune_opacity=0.0)
    done = density.adapt(EXTENT, prune_large=False)
    steps = pool.steps.to_numpy()[: len(pool)]
    assert np.count_nonzero(steps == 0) == done.cloned + 2 * done.split
    assert np.count_nonzero(steps == 9) == N - done.split


def test_a_pool_that_fills_up_grows_where_gradients_are_largest(pool: GaussianField) -> None:
    gradients = np.random.default_rng(4).permutation(1000) * 1e-5 + 1e-3
    density = filled(pool, gradients, prune_opacity=0.0, clone_size=1e9)
    largest = pool.to_numpy()["position"][gradients >= np.sort(gradients)[-24]]
    assert density.adapt(EXTENT, prune_large=False) == (24, 0, 0)
    assert len(pool) == pool.capacity
    np.testing.assert_array_equal(pool.to_numpy()["position"][1000:], largest)


def test_a_reset_lowers_opacities_and_forgets_their_moments_alone(pool: GaussianField) -> None:
    density = filled(pool, np.zeros(N))
    before = pool.opacities()
    for field in (pool.opacity_logit_m, pool.opacity_logit_v, pool.position_m):
        field.fill(1.0)
    density.reset_opacities()
    assert (before < 0.01).any()
    assert (before > 0.01).any()
    np.testing.assert_allclose(pool.opacities(), np.minimum(before, 0.01), rtol=1e-5)
    assert (pool.opacity_logit_m.to_numpy()[:N] == 0).all()
    assert (pool.opacity_logit_v.to_numpy()[:N] == 0).all()
    assert (pool.position_m.to_numpy()[:N] == 1).all()
