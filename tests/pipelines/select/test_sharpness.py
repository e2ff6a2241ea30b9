from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipelines.select.gate import sharpness


def photograph(seed: int, size: tuple[int, int] = (120, 160)) -> np.ndarray:
    """Edges of many sizes and directions, without steps: (H, W, 3) uint8."""
    rng = np.random.default_rng(seed)
    image = np.full((*size, 3), 90, dtype=np.uint8)
    for _ in range(150):
        corners = rng.uniform((0, 0), size[::-1], (1, 2)) + rng.uniform(-25, 25, (3, 2))
        cv2.fillPoly(image, [corners.astype(np.int32)], rng.uniform(0, 255, 3).tolist(), lineType=cv2.LINE_AA)
    return image


def smeared(image: np.ndarray, pixels: int, degrees: float) -> np.ndarray:
    """`image` as a camera that moves by `pixels` while its shutter is open takes it."""
    steps = np.linspace(-0.5, 0.5, 4 * pixels) * pixels
    x, y = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    height, width = image.shape[:2]
    moved = [
        cv2.warpAffine(image.astype(np.float32), np.array([[1, 0, s * x], [0, 1, s * y]]), (width, height))
        for s in steps
    ]
    return np.mean(moved, axis=0).astype(np.uint8)


def test_pictures_of_other_things_are_as_sharp() -> None:
    values = [sharpness(photograph(seed)) for seed in range(5)]
    assert np.ptp(values) < 0.15 * np.mean(values)


@pytest.mark.parametrize("degrees", [0, 30, 45, 90, 135])
@pytest.mark.parametrize("pixels", [3, 6])
def test_moving_along_any_line_takes_a_quarter(pixels: int, degrees: float) -> None:
    assert sharpness(smeared(photograph(1), pixels, degrees)) < 0.75 * sharpness(photograph(1))


def test_brightness_and_contrast_do_not_count() -> None:
    image = photograph(2)
    assert sharpness((0.4 * image + 50).astype(np.uint8)) == pytest.approx(sharpness(image), rel=0.05)


def test_nothing_to_see_is_not_sharp() -> None:
    assert sharpness(np.full((40, 40, 3), 7, dtype=np.uint8)) == 0.0
    assert sharpness(photograph(3)[:5]) == 0.0
