"""Masks and vignettes of stored images: which pixels are valid, and which share of the light reaches them."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import read_bytes, reading
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.sources.image_folder import ImageFolder
from modp_ti.inputs.sources.image_header import why_undecodable
from modp_ti.inputs.sources.listed_images import ListedImages, decoded_as
from modp_ti.inputs.sources.undistortion import both_valid

VALID_FROM = 128  # grey value
# Pixels that get a smaller share of the light than this are mostly noise and are masked.
LEAST_LIGHT = 0.05


class MaskFolder:
    """One mask per image, white where it is valid and black where it is ignored. What is transparent counts as black.

    A mask has the image's path relative to the folder, or only its name. Its suffix replaces the image's own or is
    appended to it: `0001.png` or `0001.jpg.png` for `0001.jpg`. White is the brightest value of all masks.

    Args:
        path: The folder of masks.
        named: Names of the masks relative to the folder, by image: then only these images have masks.
        setting: Where the masks are named, for error messages.

    Raises:
        InputError: If the folder does not exist or has no images.
    """

    def __init__(self, path: Path, named: Mapping[str, str] | None = None, setting: str = "source.masks") -> None:
        self._named, self._setting = named, setting
        names = None if named is None else list(dict.fromkeys(named.values()))
        self._images = (
            ImageFolder(path, setting=setting) if names is None else ListedImages(path, names, [0.0] * len(names))
        )

    def find(self, name: str) -> str | None:
        """Return the file name of the mask of the image `name`; None if the masks are named, and it has none.

        Raises:
            InputError: If there is none.
        """
        if self._named is not None:
            return self._named.get(name)
        parts = PurePosixPath(name).parts
        for first in range(len(parts)):
            tail = PurePosixPath(*parts[first:])
            for stem in (tail.with_suffix(""), tail):
                found = self._images.with_stem(str(stem))
                if found is not None:
                    return found
        raise InputError(
            f"{self._images.path}: has no mask for {name}: add {PurePosixPath(name).stem}.png, white where the image "
            f"is valid ({self._setting})"
        )

    def require_size(self, name: str, width: int, height: int) -> None:
        """Check that the mask of the image `name` has the size of the stored image, and that not all masks are black.

        Raises:
            InputError: If the mask is missing, unreadable or of another size.
        """
        mask = self.find(name)
        if mask is None:
            return
        found = self._images.size(mask)
        if found != (width, height):
            raise InputError(
                f"{self._images.path / mask} is {found[0]}x{found[1]}, its image {name} is {width}x{height}: "
                "masks must have the size of the images, turned as EXIF says"
            )
        _ = self._valid_from

    def read(self, name: str) -> NDArray[np.bool_] | None:
        """Read the validity mask (H, W) of the image `name`; None if it has none.

        Raises:
            InputError: If the mask is missing or unreadable.
        """
        mask = self.find(name)
        if mask is None:
            return None
        return both_valid(self._images.read(mask).max(axis=2) >= self._valid_from, self._images.valid(mask))

    @cached_property
    def _valid_from(self) -> int:
        """Smallest value of valid pixels: half of white. 0 for masks that are black, of which the alpha counts."""
        brightest = 0
        for mask in self._images.names:
            with suppress(UnreadableImageError):
                brightest = max(brightest, int(self._images.read(mask).max()))
            if brightest >= VALID_FROM:
                return VALID_FROM
        if brightest == 0 and all(self._images.valid(mask) is None for mask in self._images.names):
            raise InputError(
                f"{self._images.path}: all masks are black, so that no pixel would be mapped: draw white where the "
                f"images are valid ({self._setting})"
            )
        return (brightest + 1) // 2


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

    with reading(path, "; it should be the vignette (source.vignette)"):
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
