"""Image pyramids."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera

# Even the largest images are thumbnails after this many levels.
MAX_LEVELS = 8

# Minimum shorter side of a level [px]: twice the width of the loss's window.
MIN_SIDE = 22


@dataclass(frozen=True, slots=True)
class ImageLevel:
    """One level of an image pyramid.

    Attributes:
        rgba: Image (H, W, 4) uint8; the last channel is 255 at valid pixels.
        camera: Camera of the level.
        on_disk: Whether the image lies in a memory-mapped file, and takes no memory unless it is read.
    """

    rgba: NDArray[np.uint8]
    camera: PinholeCamera
    on_disk: bool = False

    @property
    def nbytes(self) -> int:
        """Bytes that the image takes in memory."""
        return 0 if self.on_disk else self.rgba.nbytes


def build_pyramid(rgba: NDArray[np.uint8], camera: PinholeCamera, levels: int = MAX_LEVELS) -> tuple[ImageLevel, ...]:
    """Build an image pyramid of halved sizes, by area averaging.

    A pixel is valid if all pixels that it covers are valid.

    Args:
        rgba: Image (H, W, 4) uint8 with its mask in the last channel.
        camera: Camera of the image.
        levels: Maximum number of levels.

    Returns:
        The levels, the given image first. No level has a side shorter than 22 pixels, except possibly the first.
    """
    pyramid = [ImageLevel(rgba, camera)]
    while len(pyramid) < levels:
        above = pyramid[-1]
        width, height = above.camera.width // 2, above.camera.height // 2
        if min(width, height) < MIN_SIDE:
            break
        smaller = np.asarray(cv2.resize(above.rgba, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
        smaller[smaller[..., 3] < 255] = 0
        pyramid.append(ImageLevel(smaller, above.camera.resized(width, height)))
    return tuple(pyramid)
