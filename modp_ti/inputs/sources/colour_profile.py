"""Conversion of images with a colour profile (ICC) to sRGB, where the profile's colours differ from sRGB's."""

from __future__ import annotations

import io
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

__all__ = ["in_srgb", "profile_name"]

# Largest difference of a colour [of 255] between sRGB and a profile that is taken for it. Profiles of sRGB differ by
# rounding, Adobe RGB by 60.
SAME = 3
LONGEST = 1 << 22  # bytes of a profile


def in_srgb(image: NDArray[np.uint8], profile: bytes) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) in sRGB. Without a profile of other colours it is returned as it is."""
    transform = _transform(profile) if profile else None
    return image if transform is None else _applied(transform, image)


def profile_name(profile: bytes) -> str | None:
    """Return the name of a profile whose colours `in_srgb` converts, None for others."""
    if not profile or _transform(profile) is None:
        return None
    try:
        name = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile)))
    except (ImageCms.PyCMSError, OSError, ValueError):
        name = ""
    return "".join(filter(str.isprintable, name)).strip()[:60] or "another colour space"


@lru_cache(maxsize=64)
def _transform(profile: bytes) -> ImageCms.ImageCmsTransform | None:
    """The way from a profile to sRGB; None if it is not of RGB images, is damaged, or has sRGB's colours."""
    if profile[16:20] != b"RGB " or len(profile) > LONGEST:
        return None
    levels = np.linspace(0, 255, 6)
    grid = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(6, 36, 3).astype(np.uint8)
    try:
        given, wanted = ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
        transform = ImageCms.ImageCmsTransform(given, ImageCms.ImageCmsProfile(wanted), "RGB", "RGB")
        difference = np.abs(_applied(transform, grid).astype(int) - grid)
    except (ImageCms.PyCMSError, OSError, ValueError):
        return None
    return transform if difference.max() > SAME else None


def _applied(transform: ImageCms.ImageCmsTransform, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.array(transform.apply(Image.fromarray(image)), dtype=np.uint8)
