"""Gradients of the whole renderer in float64 against central finite differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3
from fields.runtime.engine import ti
from pipelines.render.renderer import Renderer
from tests.pipelines.differences import STEP, central_differences
from tests.pipelines.scenes import CAMERA, NEAR, POSE, random_gaussians

pytestmark = pytest.mark.slow


def scene(degree: int) -> dict[str, NDArray[np.float64]]:
    """Gaussians that reach across the whole picture above the cut at 1/255, so that the picture is smooth in all."""
    return random_gaussians(5, seed=3, degree=degree, size=(14.0, 25.0), logit=(0.0, 1.5), beyond=-0.2)


class Functional:
    """A random linear functional of colour, depth and opacity."""

    def __init__(self, renderer: Renderer) -> None:
        rng = np.random.default_rng(7)
        shape = (CAMERA.height, CAMERA.width)
        self.renderer = renderer
        self.colour, self.depth, self.opacity = (
            rng.normal(size=(*shape, 3)),
            rng.normal(size=shape),
            rng.normal(size=shape),
        )

    def value(self, state: dict[str, NDArray], pose: NDArray = POSE) -> float:
        self.renderer.gaussians.load(state)
        view = self.renderer.render(CAMERA, pose, NEAR)
        return float(
            (view.colour * self.colour).sum() + (view.depth * self.depth).sum() + (view.opacity * self.opacity).sum()
        )

    def gradients(self, state: dict[str, NDArray]) -> tuple[dict[str, NDArray], NDArray]:
        """Of the Gaussians by name, and of the camera tangent (6,)."""
        self.value(state)
        self.renderer.images.set_gradients(self.colour, self.depth, self.opacity)
        self.renderer.backward(with_depth=True)
        return self.renderer.gaussians.gradients_to_numpy(), self.renderer.camera_gradient()


def assert_agree(analytic: NDArray, numeric: NDArray) -> None:
    """Relative to the largest entry: below 1e-4 everywhere."""
    assert np.abs(numeric).max() > 1e-3  # the functional depends on it
    assert np.abs(analytic - numeric).max() / np.abs(numeric).max() < 1e-4


@pytest.mark.parametrize("degree", [0, 3])
def test_the_gradients_of_all_parameters_and_of_the_camera_are_those_of_finite_differences(
    renderers: Callable[..., Renderer], degree: int
) -> None:
    functional, state = Functional(renderers(degree, ti.f64)), scene(degree)
    gradients, camera = functional.gradients(state)
    for name in ("position", "log_scale", "quaternion", "opacity_logit", "sh"):
        assert_agree(gradients[name], central_differences(functional.value, state, name))
    numeric = np.zeros(6)
    for k in range(6):
        xi = np.zeros(6)
        xi[k] = STEP
        values = [functional.value(state, exp_se3(sign * xi) @ POSE) for sign in (1, -1)]
        numeric[k] = (values[0] - values[1]) / (2 * STEP)
    assert_agree(camera, numeric)


def test_gradients_of_two_runs_are_bit_identical(renderers: Callable[..., Renderer]) -> None:
    functional = Functional(renderers(0, ti.f32))
    state = random_gaussians(600, seed=5)
    first, first_camera = functional.gradients(state)
    second, second_camera = functional.gradients(state)
    assert all(np.abs(value).max() > 0 for value in first.values())
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name])
    np.testing.assert_array_equal(first_camera, second_camera)
