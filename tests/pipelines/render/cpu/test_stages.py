"""The stages on the CPU against plain twins: binning, the photometric model, and the fast power of two."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.buffers.tiles import TILE_HEIGHT, TILE_WIDTH
from fields.geometry.camera import PinholeCamera
from fields.runtime.engine import ti
from pipelines.render.formulas import ALPHA_MIN, IDENTITY
from pipelines.render.renderer import Renderer
from tests.pipelines import reference
from tests.pipelines.differences import STEP, central_differences
from tests.pipelines.render.cpu.exp2_kernels import powers
from tests.pipelines.scenes import CAMERA, NEAR, POSE, random_gaussians

pytestmark = pytest.mark.slow

Lists = dict[int, list[tuple[int, int, int]]]


def lists(renderer: Renderer, state: dict[str, NDArray]) -> tuple[Lists, NDArray]:
    """(rank in depth, first row, row behind the last) of every tile, and the Gaussian of every rank."""
    renderer.gaussians.load(state)
    renderer.forward(CAMERA, POSE, NEAR)
    pairs = renderer.pairs
    slot, rows = pairs.slot.to_numpy()[: pairs.count], pairs.rows_to_numpy()
    first, count = pairs.first.to_numpy(), pairs.tile_count.to_numpy()
    order = renderer.projected.order.to_numpy()[: renderer.projected.count]
    rank = np.argsort(order)
    tiles = -(-CAMERA.width // TILE_WIDTH) * -(-CAMERA.height // TILE_HEIGHT)
    result: Lists = {}
    for tile in range(tiles):
        span = slice(first[tile], first[tile] + count[tile])
        ranks = rank[slot[span]]
        result[tile] = [(int(k), int(r & 0xFFFF), int(r >> 16)) for k, r in zip(ranks, rows[span], strict=True)]
    return result, renderer.projected.gaussian.to_numpy()[order]


@pytest.fixture(params=[(0.5, 5.0), (0.05, 40.0)], ids=["small", "needles"])
def case(request: pytest.FixtureRequest, renderers: Callable[..., Renderer]) -> tuple[Lists, NDArray, NDArray]:
    """Lists, Gaussians by rank in depth, and alpha (N, H, W) of the plain renderer by Gaussian."""
    state = random_gaussians(150, seed=4, size=request.param, logit=(-5.0, 3.0))
    splats = reference.project(state, CAMERA, POSE, NEAR)
    alpha = np.zeros((150, CAMERA.height, CAMERA.width))
    alpha[splats.index] = splats.alpha(CAMERA.width, CAMERA.height)
    return *lists(renderers(0, ti.f64), state), alpha


def reached(alpha: NDArray, tile: int) -> NDArray[np.bool_]:
    """Which rows (N, rows) of a tile each Gaussian is drawn on."""
    tiles_x = -(-CAMERA.width // TILE_WIDTH)
    y, x = tile // tiles_x * TILE_HEIGHT, tile % tiles_x * TILE_WIDTH
    return (alpha[:, y : y + TILE_HEIGHT, x : x + TILE_WIDTH] >= ALPHA_MIN).any(axis=2)


def test_no_pixel_misses_a_gaussian_that_reaches_it(case: tuple[Lists, NDArray, NDArray]) -> None:
    tiles, gaussian, alpha = case
    for tile, entries in tiles.items():
        listed = {int(gaussian[k]): (top, bottom) for k, top, bottom in entries}
        for g, row in np.argwhere(reached(alpha, tile)):
            assert listed[int(g)][0] <= row < listed[int(g)][1]


def test_few_pairs_are_listed_in_vain(case: tuple[Lists, NDArray, NDArray]) -> None:
    tiles, _, alpha = case
    listed = sum(len(entries) for entries in tiles.values())
    needed = sum(int(reached(alpha, tile).any(axis=1).sum()) for tile in tiles)
    # An ellipse may touch a tile between its pixel centres, no more.
    assert needed <= listed <= 1.15 * needed


def test_slots_are_in_the_order_of_the_gaussians_and_ordered_by_depth(renderers: Callable[..., Renderer]) -> None:
    renderer = renderers(0, ti.f64)
    lists(renderer, random_gaussians(150, seed=4))
    count = renderer.projected.count
    order = renderer.projected.order.to_numpy()[:count]
    assert (np.diff(renderer.projected.gaussian.to_numpy()[:count]) > 0).all()
    assert (np.diff(renderer.projected.depth.to_numpy()[order]) >= 0).all()
    assert sorted(order) == list(range(count))


def test_every_slot_finds_its_pairs_again(renderers: Callable[..., Renderer]) -> None:
    renderer = renderers(0, ti.f64)
    lists(renderer, random_gaussians(300, seed=6))
    count = renderer.pairs.count
    first, end = renderer.projected.first_pair.to_numpy(), renderer.projected.end_pair.to_numpy()
    position = renderer.pairs.position.to_numpy()[:count]
    slot = renderer.pairs.slot.to_numpy()[:count]
    assert sorted(position) == list(range(count))
    for s in range(renderer.projected.count):
        assert (slot[position[first[s] : end[s]]] == s).all()
    assert sum(end[s] - first[s] for s in range(renderer.projected.count)) == count


SHAPE = (CAMERA.height, CAMERA.width, 3)
EXPOSURE = IDENTITY + np.random.default_rng(1).normal(scale=0.2, size=(3, 4))
VIGNETTE = np.random.default_rng(2).uniform(0.2, 1.0, SHAPE).astype(np.float32)


def pictures(renderer: Renderer, exposure: NDArray | None, vignette: NDArray | None) -> tuple[NDArray, NDArray]:
    """The picture as it is rendered, and as it is developed."""
    renderer.forward(CAMERA, POSE, NEAR)
    rendered = renderer.images.colour_to_numpy()
    renderer.develop(exposure, vignette)
    return rendered, renderer.images.colour_to_numpy()


@pytest.mark.parametrize("exposure", [None, EXPOSURE])
@pytest.mark.parametrize("vignette", [None, VIGNETTE])
def test_the_picture_is_developed_by_the_formula(
    renderer: Renderer, exposure: NDArray | None, vignette: NDArray | None
) -> None:
    renderer.gaussians.load(random_gaussians(30, seed=4))
    rendered, developed = pictures(renderer, exposure, vignette)
    expected = rendered
    if exposure is not None:
        expected = expected @ exposure[:, :3].T + exposure[:, 3]
    if vignette is not None:
        expected = expected * vignette
    np.testing.assert_allclose(developed, expected, atol=2e-6)


def test_a_vignette_is_resized_to_the_level_that_is_rendered(renderer: Renderer) -> None:
    renderer.gaussians.load(random_gaussians(30, seed=4))
    large = np.random.default_rng(5).uniform(0.2, 1.0, (48, 64, 3)).astype(np.float32)
    for width, height in ((64, 48), (32, 24), (16, 12), (64, 48)):
        renderer.forward(PinholeCamera(40.0, 40.0, 32.0, 24.0, 64, 48).resized(width, height), POSE, NEAR)
        rendered = renderer.images.colour_to_numpy()
        renderer.develop(None, large)
        blocks = large.reshape(height, 48 // height, width, 64 // width, 3).mean(axis=(1, 3))
        np.testing.assert_allclose(renderer.images.colour_to_numpy(), rendered * blocks, atol=2e-6)


class Functional:
    """A random linear functional of the developed picture."""

    def __init__(self, renderer: Renderer) -> None:
        self.renderer = renderer
        self.weights = np.random.default_rng(7).normal(size=SHAPE)

    def value(self, state: dict[str, NDArray], exposure: NDArray = EXPOSURE) -> float:
        self.renderer.gaussians.load(state)
        return float((pictures(self.renderer, exposure, VIGNETTE)[1] * self.weights).sum())

    def backward(self, state: dict[str, NDArray]) -> None:
        self.value(state)
        nothing = np.zeros(SHAPE[:2])
        self.renderer.images.set_gradients(self.weights, nothing, nothing)
        self.renderer.backward()


@pytest.fixture
def functional(renderers: Callable[..., Renderer]) -> Functional:
    return Functional(renderers(0, ti.f64))


STATE = random_gaussians(5, seed=3, size=(14.0, 25.0), logit=(0.0, 1.5), beyond=-0.2)


@pytest.mark.parametrize("name", ["sh", "opacity_logit", "position"])
def test_the_gradients_of_the_gaussians_are_those_of_finite_differences(functional: Functional, name: str) -> None:
    functional.backward(STATE)
    analytic = functional.renderer.gaussians.gradients_to_numpy()[name]
    numeric = central_differences(functional.value, STATE, name)
    assert np.abs(numeric).max() > 1e-3
    assert np.abs(analytic - numeric).max() / np.abs(numeric).max() < 1e-4


def test_the_gradient_of_the_exposure_is_that_of_finite_differences(functional: Functional) -> None:
    functional.backward(STATE)
    analytic = functional.renderer.exposure_gradient()
    numeric = np.zeros((3, 4))
    for place in np.ndindex(3, 4):
        change = np.zeros((3, 4))
        change[place] = STEP
        up, down = functional.value(STATE, EXPOSURE + change), functional.value(STATE, EXPOSURE - change)
        numeric[place] = (up - down) / (2 * STEP)
    assert np.abs(analytic - numeric).max() / np.abs(numeric).max() < 1e-6


def test_a_developed_picture_leaves_nothing_behind_for_the_next(renderer: Renderer) -> None:
    """Gradients of a picture that is not developed, before and after one that is."""
    state = random_gaussians(30, seed=4)
    weights = np.random.default_rng(8).normal(size=SHAPE)

    def gradients(exposure: NDArray | None, vignette: NDArray | None) -> NDArray:
        renderer.gaussians.load(state)
        pictures(renderer, exposure, vignette)
        renderer.images.set_gradients(weights, np.zeros(SHAPE[:2]), np.zeros(SHAPE[:2]))
        renderer.backward()
        return renderer.gaussians.gradients_to_numpy()["sh"]

    before = gradients(None, None)
    assert not np.allclose(gradients(EXPOSURE, VIGNETTE), before)
    np.testing.assert_array_equal(gradients(None, None), before)


@pytest.mark.parametrize(("real", "tolerance"), [(ti.f32, 4e-7), (ti.f64, 2e-14)])
def test_it_is_the_power_of_two(real: object, tolerance: float) -> None:
    dtype = np.float32 if real == ti.f32 else np.float64
    x = np.concatenate([np.linspace(-124, 0, 200_001), -np.logspace(-9, 1, 1000)]).astype(dtype)
    expected = np.exp2(x.astype(np.float64))
    assert (np.abs(powers(x, real) / expected - 1) <= tolerance).all()
