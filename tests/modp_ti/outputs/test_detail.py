from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from modp_ti.outputs.evaluation import explained_detail

WHOLE = np.ones((40, 60), dtype=bool)


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=(40, 60, 3)).astype(np.float32)


def test_the_image_itself_explains_all_and_a_constant_nothing() -> None:
    image = noise(0)
    assert explained_detail(image, image, WHOLE) == 1.0
    assert explained_detail(np.full_like(image, 0.3), image, WHOLE) == pytest.approx(0.0, abs=1e-5)
    assert explained_detail(image, np.full_like(image, 0.5), np.zeros_like(WHOLE)) is None


def test_it_is_the_share_of_the_band_above_a_blur_of_one_pixel() -> None:
    image, render = noise(1), 0.7 * noise(1) + 0.3 * noise(2)

    def band(picture: np.ndarray) -> np.ndarray:
        return picture - gaussian_filter(picture.astype(np.float64), (1, 1, 0), mode="mirror", truncate=3.0)

    expected = 1 - np.square(band(image - render)).sum() / np.square(band(image)).sum()
    # OpenCV cuts the Gaussian off at another radius than SciPy.
    assert explained_detail(render, image, WHOLE) == pytest.approx(expected, abs=5e-3)


def test_a_change_of_brightness_costs_nothing_and_a_blur_nearly_all() -> None:
    image = noise(3)
    assert explained_detail(image + 0.1, image, WHOLE) == pytest.approx(1.0, abs=1e-6)
    assert explained_detail(gaussian_filter(image, (4, 4, 0)), image, WHOLE) < 0.1


def test_masked_pixels_do_not_matter() -> None:
    image, render = noise(4), 0.5 * noise(4)
    valid = WHOLE.copy()
    valid[10:20, 5:50] = False
    expected = explained_detail(render, image, valid)
    for picture in (image, render):
        picture[~valid] = noise(5)[~valid]
    assert explained_detail(render, image, valid) == pytest.approx(expected, abs=1e-6)
