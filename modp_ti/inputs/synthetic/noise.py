"""Noise and small drawing helpers for the procedural textures.

Colours are sRGB in [0, 255]; images are float32 until `finish`.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Colour",
    "Floats",
    "Image",
    "blend",
    "filled",
    "finish",
    "fractal",
    "grid",
    "mix",
    "smooth_noise",
    "smoothstep",
]

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]
Colour = Sequence[float]


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], cell: tuple[float, float]) -> Floats:
    """Standard-normal values on a grid of `cell` (down, across) pixels, interpolated to `shape`.

    Repeats without a seam.
    """
    height, width = int(shape[0]), int(shape[1])
    rows, columns = max(1, round(height / float(cell[0]))), max(1, round(width / float(cell[1])))
    values = rng.standard_normal((rows, columns)).astype(np.float32)
    x = (np.arange(width, dtype=np.float32) + 0.5) * (columns / width) - 0.5
    y = (np.arange(height, dtype=np.float32) + 0.5) * (rows / height) - 0.5
    margin = 2
    values = np.pad(values, margin, mode="wrap")
    return cv2.remap(values, *np.meshgrid(x + margin, y + margin), cv2.INTER_CUBIC)


def fractal(
    rng: np.random.Generator,
    shape: tuple[int, int],
    cell: float | tuple[float, float],
    octaves: int = 4,
    gain: float = 0.55,
) -> Floats:
    """Sum of `octaves` of smooth noise, each of half the cell and `gain` times the height; unit variance."""
    down, across = (cell, cell) if isinstance(cell, int | float) else cell
    total = np.zeros(shape, np.float32)
    for k in range(octaves):
        total += gain**k * smooth_noise(rng, shape, (max(down / 2**k, 1), max(across / 2**k, 1)))
    return total / max(float(total.std()), 1e-6)


def grid(shape: tuple[int, int], size: tuple[float, float]) -> tuple[Floats, Floats]:
    """Coordinates (x, y) of the pixel centres over `size` (width, height)."""
    x = (np.arange(shape[1], dtype=np.float32) + 0.5) * np.float32(size[0] / shape[1])
    y = (np.arange(shape[0], dtype=np.float32) + 0.5) * np.float32(size[1] / shape[0])
    return tuple(np.meshgrid(x, y))


def filled(shape: tuple[int, int], colour: Colour) -> Floats:
    """An image of one colour."""
    return np.broadcast_to(np.asarray(colour, np.float32), (*shape, 3)).copy()


def mix(a: Floats | Colour, b: Floats | Colour, weight: Floats) -> Floats:
    """a where the weight (H, W) is 0, b where it is 1."""
    w = weight[..., None]
    return np.asarray(a, np.float32) * (1 - w) + np.asarray(b, np.float32) * w


def blend(image: Floats, colour: Colour, mask: Floats) -> None:
    """Paint a colour over an image, in place, with the opacities of a mask (H, W)."""
    image += (np.asarray(colour, np.float32) - image) * mask[..., None]


def smoothstep(low: float, high: float, x: Floats) -> Floats:
    """0 below low, 1 above high, smooth between."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def finish(image: Floats) -> Image:
    """Clipped and rounded to 8 bits."""
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
