"""The losses against scikit-image, NumPy and finite differences, in float64."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from fields.map.gaussians import GaussianField
from fields.runtime.engine import ti
from pipelines.optimise.adam import AspectPenalty
from pipelines.render.cpu.losses import PhotometricLoss
from pipelines.render.formulas import LossValues
from pipelines.render.renderer import Renderer

WIDTH, HEIGHT = 41, 33


@pytest.fixture(scope="module")
def losses(renderers: Callable[..., Renderer]) -> PhotometricLoss:
    """In float64, on images of 41x33."""
    renderer = renderers(0, ti.f64)
    renderer.images.resize(WIDTH, HEIGHT)
    return PhotometricLoss(renderer.images)


def textures(seed: int) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """A render and a reference with a likeness."""
    rng = np.random.default_rng(seed)
    reference = np.full((HEIGHT, WIDTH, 4), 255, dtype=np.uint8)
    reference[..., :3] = rng.integers(0, 256, (HEIGHT, WIDTH, 3))
    return np.clip(reference[..., :3] / 255 + rng.normal(0, 0.2, (HEIGHT, WIDTH, 3)), 0, 1), reference


def compare(loss: PhotometricLoss, render: NDArray, reference: NDArray) -> LossValues:
    # The gradient buffers take any image; the rendered one is then copied from there.
    zeros = np.zeros((HEIGHT, WIDTH))
    loss.images.set_gradients(render, zeros, zeros)
    loss.images.colour.copy_from(loss.images.colour_grad)
    return loss.forward(reference)


def total(loss: PhotometricLoss, render: NDArray, reference: NDArray, weight: float) -> float:
    values = compare(loss, render, reference)
    return (1 - weight) * values.l1 + weight * (1 - values.ssim)


def test_ssim_is_that_of_scikit_image(losses: PhotometricLoss) -> None:
    render, reference = textures(1)
    compare(losses, render, reference)
    _, expected = structural_similarity(
        render, reference[..., :3] / 255, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        data_range=1.0, channel_axis=2, full=True,
    )  # fmt: skip
    inside = (slice(5, -5), slice(5, -5))  # at the border the two continue the image differently
    np.testing.assert_allclose(losses.images.ssim_to_numpy()[inside], expected[inside], atol=1e-9)


def test_l1_and_psnr_are_those_of_numpy(losses: PhotometricLoss) -> None:
    render, reference = textures(2)
    values = compare(losses, render, reference)
    difference = render - reference[..., :3] / 255
    assert values.l1 == pytest.approx(np.abs(difference).mean())
    assert values.psnr == pytest.approx(-10 * np.log10((difference**2).mean()))


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("masked", [False, True])
def test_the_gradient_is_that_of_finite_differences(losses: PhotometricLoss, weight: float, masked: bool) -> None:
    render, reference = textures(4)
    if masked:
        reference[10:20, 5:30] = 0
    compare(losses, render, reference)
    losses.backward(weight, scale=2.0)
    analytic = losses.images.colour_gradient_to_numpy()
    rng = np.random.default_rng(5)
    step = 1e-6
    for _ in range(25):
        at = rng.integers(HEIGHT), rng.integers(WIDTH), rng.integers(3)
        values = []
        for sign in (1, -1):
            moved = render.copy()
            moved[at] += sign * step
            values.append(2.0 * total(losses, moved, reference, weight))
        numeric = (values[0] - values[1]) / (2 * step)
        assert analytic[at] == pytest.approx(numeric, rel=1e-4, abs=1e-9)


def test_masked_pixels_change_nothing(losses: PhotometricLoss) -> None:
    render, reference = textures(6)
    reference[8:25, 8:25] = 0
    clean = total(losses, render, reference, 0.3)
    render[8:25, 8:25] = 123.0
    assert total(losses, render, reference, 0.3) == pytest.approx(clean, rel=1e-12)
    losses.backward(0.3)
    assert (losses.images.colour_gradient_to_numpy()[8:25, 8:25] == 0).all()


def test_the_aspect_penalty_has_the_gradient_of_its_formula(renderers: Callable[..., Renderer]) -> None:
    gaussians: GaussianField = renderers(0, ti.f64).gaussians
    rng = np.random.default_rng(8)
    log_scale = rng.normal(0, 1.5, (30, 3))
    log_scale[0] = [0.0, 0.1, 0.2]  # round enough
    gaussians.load(
        {
            "position": np.zeros((30, 3)),
            "log_scale": log_scale,
            "quaternion": np.ones((30, 4)),
            "opacity_logit": np.zeros(30),
            "sh": np.zeros((30, 1, 3)),
        }
    )
    touched = np.zeros(gaussians.touched.shape, dtype=np.int32)
    touched[:29] = 1
    gaussians.touched.from_numpy(touched)
    AspectPenalty(gaussians).backward(weight=3.0, scene_depth=2.0)
    analytic = gaussians.gradients_to_numpy()["log_scale"]

    def penalty(values: NDArray) -> float:
        s = np.exp(values[:29]) / 2.0
        return 3.0 / 30 * (np.maximum(s.max(axis=1) - 10 * s.min(axis=1), 0) ** 2).sum()

    numeric = np.zeros_like(analytic)
    for index in np.ndindex(*analytic.shape):
        moved = [log_scale.copy(), log_scale.copy()]
        moved[0][index] += 1e-6
        moved[1][index] -= 1e-6
        numeric[index] = (penalty(moved[0]) - penalty(moved[1])) / 2e-6
    assert (analytic[0] == 0).all()
    assert (analytic[29] == 0).all()  # no view saw it
    np.testing.assert_allclose(analytic, numeric, rtol=1e-5, atol=1e-7)
