"""Masks and vignettes of stored images: which pixels are valid, and which share of the light reaches them."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import read_bytes, readable
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.image_bounds import why_undecodable
from modp_ti.inputs.sources.image_folder import ImageFolder
from modp_ti.inputs.sources.listed_images import decoded_as

__all__ = ["LEAST_LIGHT", "MaskFolder", "differs_from_colour", "read_vignette"]

VALID_FROM = 128  # grey value
# Pixels that get a smaller share of the light than this are mostly noise and are masked.
LEAST_LIGHT = 0.05


class MaskFolder:
    """One mask per image, white where it is valid and black where it is ignored.

    A mask has the image's path relative to the folder, or only its name. Its suffix replaces the image's own or is
    appended to it: `0001.png` or `0001.jpg.png` for `0001.jpg`.

    Args:
        path: The folder of masks.

    Raises:
        InputError: If the folder does not exist or has no images.
    """

    def __init__(self, path: Path) -> None:
        self._images = ImageFolder(path, setting="source.masks")

    def find(self, name: str) -> str:
        """Return the file name of the mask of the image `name`.

        Raises:
            InputError: If there is none.
        """
        parts = PurePosixPath(name).parts
        for first in range(len(parts)):
            tail = PurePosixPath(*parts[first:])
            for stem in (tail.with_suffix(""), tail):
                found = self._images.with_stem(str(stem))
                if found is not None:
                    return found
        raise InputError(
            f"{self._images.path}: has no mask for {name}: add {PurePosixPath(name).stem}.png, white where the image "
            "is valid (source.masks)"
        )

    def require_size(self, name: str, width: int, height: int) -> None:
        """Check that the mask of the image `name` has the size of the stored image.

        Raises:
            InputError: If the mask is missing, unreadable or of another size.
        """
        mask = self.find(name)
        found = self._images.size(mask)
        if found != (width, height):
            raise InputError(
                f"{self._images.path / mask} is {found[0]}x{found[1]}, its image {name} is {width}x{height}: "
                "masks must have the size of the images, turned as EXIF says"
            )

    def read(self, name: str) -> NDArray[np.bool_]:
        """Read the validity mask (H, W) of the image `name`.

        Raises:
            InputError: If the mask is missing or unreadable.
        """
        return self._images.read(self.find(name)).max(axis=2) >= VALID_FROM


def differs_from_colour(image: NDArray[np.uint8], colour: tuple[int, int, int], tolerance: int) -> NDArray[np.bool_]:
    """Return a mask (H, W), True where a channel of the image (H, W, 3) differs from `colour` by over `tolerance`."""
    difference = np.abs(image.astype(np.int16) - np.array(colour, dtype=np.int16))
    return np.any(difference > tolerance, axis=2)


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
