"""The developed picture is (A colour + b) * vignette, and the gradients are those of finite differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.runtime.engine import ti
from pipelines.render.cpu.photometric_model import IDENTITY
from pipelines.render.renderer import Renderer
from tests.pipelines.differences import STEP, central_differences
from tests.pipelines.scenes import CAMERA, NEAR, POSE, random_gaussians

pytestmark = pytest.mark.slow

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


def test_the_sums_of_the_exposure_gradient_are_bit_identical(renderer: Renderer) -> None:
    renderer.gaussians.load(random_gaussians(30, seed=4))
    weights = np.random.default_rng(8).normal(size=SHAPE)

    def gradient() -> NDArray:
        pictures(renderer, EXPOSURE, VIGNETTE)
        renderer.images.set_gradients(weights, np.zeros(SHAPE[:2]), np.zeros(SHAPE[:2]))
        renderer.backward()
        return renderer.exposure_gradient()

    first = gradient()
    assert all(np.array_equal(first, gradient()) for _ in range(5))
