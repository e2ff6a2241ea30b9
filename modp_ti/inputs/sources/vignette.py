"""Reading of vignette images: the share of the light that reaches each pixel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import read_bytes, readable
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.image_bounds import why_undecodable
from modp_ti.inputs.sources.listed_images import decoded_as

__all__ = ["LEAST_LIGHT", "read_vignette"]

# Pixels that get a smaller share of the light than this are mostly noise and are masked.
LEAST_LIGHT = 0.05


def read_vignette(path: Path) -> NDArray[np.float32]:
    """Read a vignette (H, W, 3) float32, normalised to a maximum of 1.

    Args:
        path: A grey or colour image of 8 or 16 bits.

    Raises:
        InputError: If the image is unreadable or black.
    """
    import cv2

    with readable(path, "; it should be the vignette (source.vignette)"):
        data = read_bytes(path)
    reason = why_undecodable(data)
    if data and reason is not None:
        raise InputError(f"{path}: the vignette is no image that can be used: {reason} (source.vignette)")
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = decoded_as(data, flags) if data else None
    if image is None or not 0 < image.max() < np.inf:
        raise InputError(f"{path}: the vignette is {'no image' if image is None else 'black'} (source.vignette)")
    image = image.astype(np.float32) / float(image.max())
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., ::-1])
