"""Conversion of images with a colour profile (ICC) to sRGB, where the profile's colours differ from sRGB's."""

from __future__ import annotations

import io
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

__all__ = ["in_srgb", "way_to_srgb"]

# Largest difference of a colour [of 255] from sRGB of a profile that is taken for it. Adobe RGB differs by 60.
SAME = 3


def in_srgb(image: NDArray[np.uint8], profile: bytes) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) in sRGB. Without a profile of other colours it is returned as it is."""
    way = way_to_srgb(profile)
    return image if way is None else np.array(way.apply(Image.fromarray(image)), dtype=np.uint8)


@lru_cache(maxsize=64)
def way_to_srgb(profile: bytes) -> ImageCms.ImageCmsTransform | None:
    """Return the conversion from a profile to sRGB; None if it is not of RGB, is damaged, or has sRGB's colours."""
    if profile[16:20] != b"RGB ":
        return None
    levels = np.arange(0, 256, 51, dtype=np.uint8)
    grid = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(6, 36, 3)
    try:
        given, wanted = ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
        way = ImageCms.ImageCmsTransform(given, ImageCms.ImageCmsProfile(wanted), "RGB", "RGB")
        difference = np.abs(np.asarray(way.apply(Image.fromarray(grid))).astype(int) - grid)
    except (ImageCms.PyCMSError, OSError, ValueError):
        return None
    return way if difference.max() > SAME else None
