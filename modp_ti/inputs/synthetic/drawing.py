"""Letters, discs and polygons on float32 images, with subpixel positions and smooth edges."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from modp_ti.inputs.synthetic.noise import Colour, Floats, blend

__all__ = ["disc", "polygon", "text"]


def text(image: Floats, words: str, at: tuple[float, float], height: float, colour: Colour, thickness: int = 1) -> None:
    """Letters of `height` pixels, their baseline starting at `at` (x, y)."""
    top = max(0, round(at[1] - 1.6 * height))
    line = image[top : round(at[1] + 0.6 * height)]
    mask = np.zeros(line.shape[:2], np.uint8)  # OpenCV 5 writes on 8-bit images only
    place = (round(at[0]), round(at[1]) - top)
    cv2.putText(mask, str(words), place, cv2.FONT_HERSHEY_SIMPLEX, height / 21.0, 255, thickness, cv2.LINE_AA)
    blend(line, colour, mask.astype(np.float32) / 255)


def disc(image: Floats, at: Sequence[float], radius: float, colour: Colour, outline: int = -1) -> None:
    """A filled circle, or a ring of `outline` pixels."""
    centre = (round(at[0] * 16), round(at[1] * 16))
    cv2.circle(image, centre, round(radius * 16), tuple(colour), outline, cv2.LINE_AA, 4)


def polygon(image: Floats, points: np.ndarray, colour: Colour) -> None:
    """A filled polygon with corners (N, 2)."""
    cv2.fillPoly(image, [np.rint(points * 16).astype(np.int32)], tuple(colour), cv2.LINE_AA, 4)
