"""Image pyramid of a keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera

__all__ = ["MAX_LEVELS", "ImageLevel", "build_pyramid"]

# The eighth halving of the largest image that anyone maps is a thumbnail.
MAX_LEVELS = 8

# No level is made whose shorter side would have fewer pixels: two windows of the loss.
MIN_SIDE = 22


@dataclass(frozen=True, slots=True)
class ImageLevel:
    """One level: rgba (H, W, 4) uint8, 255 in the last channel where the pixel is valid, and its camera."""

    rgba: NDArray[np.uint8]
    camera: PinholeCamera


def build_pyramid(rgba: NDArray[np.uint8], camera: PinholeCamera, levels: int = MAX_LEVELS) -> tuple[ImageLevel, ...]:
    """Up to `levels` levels of halved size, the given image first.

    A pixel is the mean of those that it covers, and valid where all of them are.
    """
    pyramid = [ImageLevel(rgba, camera)]
    while len(pyramid) < levels:
        above = pyramid[-1]
        width, height = above.camera.width // 2, above.camera.height // 2
        if min(width, height) < MIN_SIDE:
            break
        smaller = cv2.resize(above.rgba, (width, height), interpolation=cv2.INTER_AREA)
        smaller[smaller[..., 3] < 255] = 0
        pyramid.append(ImageLevel(smaller, above.camera.resized(width, height)))
    return tuple(pyramid)
