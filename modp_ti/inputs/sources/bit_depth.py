"""Images of 16 bits per channel: how many bits a recording uses, and their reduction to 8 bits."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

__all__ = ["DEPTHS", "reduced", "used_bits"]

# Depths of cameras [bits] whose values are stored in 16 bits.
DEPTHS = (8, 10, 12, 14, 16)


def used_bits(images: Iterable[NDArray]) -> int:
    """Return the smallest depth [bits] of a camera that holds all values of the images (uint8 or uint16)."""
    largest = max((int(image.max()) for image in images), default=0)
    return next(bits for bits in DEPTHS if largest < 1 << bits)


def reduced(image: NDArray, bits: int) -> NDArray[np.uint8]:
    """Return an image of `bits` used bits (uint16) with 8 bits; larger values saturate. uint8 images stay as they are.

    A fixed scale keeps the brightness of a recording's images comparable.
    """
    if image.dtype == np.uint8:
        return image
    return np.minimum(image >> (bits - 8), 255).astype(np.uint8)
