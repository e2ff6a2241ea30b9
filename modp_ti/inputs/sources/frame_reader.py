"""Reading of frames: undistorted images with their masks and vignettes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files import read_bytes, reading
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.sources.image_folder import ImageFolder, ListedImages
from modp_ti.inputs.sources.image_header import decodable
from modp_ti.inputs.sources.image_pixels import decoded_as
from modp_ti.inputs.sources.protocol import ImageSource
from modp_ti.inputs.sources.undistortion import Undistorter, both_valid

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import SourceSettings

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
        decodable(data)
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = decoded_as(data, flags)
    if image is None or not 0 < image.max() < np.inf:
        raise InputError(f"{path}: the vignette is {'no image' if image is None else 'black'} (source.vignette)")
    image = image.astype(np.float32) / float(image.max())
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., ::-1])


# Largest relative difference of the aspect ratios of vignette and image, which allows for rounding after resizing.
ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class Picture:
    """An undistorted image at the working size.

    Attributes:
        image: Image (H, W, 3) float32 in [0, 1].
        mask: Valid pixels (H, W), or None if all are valid; as in `TrackedFrame`.
        vignette: Vignette (H, W, 3), or None; as in `TrackedFrame`.
        camera: Camera of the image.
    """

    image: NDArray[np.float32]
    mask: NDArray[np.bool_] | None
    vignette: NDArray[np.float32] | None
    camera: PinholeCamera


class FrameReader:
    """Reads frames of a source and applies `source.masks`, `source.mask_colour` and `source.vignette`.

    If the image source has a vignette of its own, that one is used: such sources have already taken `source.vignette`
    into account.

    Args:
        images: The image source.
        source: Settings of the images.
        masks: Masks that the tracker's file names, where `source.masks` is empty.

    Raises:
        InputError: If the mask folder or the vignette cannot be used.
    """

    def __init__(self, images: ImageSource, source: SourceSettings, masks: MaskFolder | None = None) -> None:
        self.images = images
        self.source = source
        self._masks = masks if source.masks is None else MaskFolder(source.masks)
        self._vignette = images.vignette
        if self._vignette is None and source.vignette is not None:
            self._vignette = read_vignette(source.vignette)
        self._of_camera: dict[Undistorter, tuple[NDArray[np.float32], NDArray[np.bool_]]] = {}

    def require_fitting(self, frames: Iterable[tuple[str, Undistorter]]) -> None:
        """Check that masks exist and match the images, and that the vignette has their aspect ratio.

        Only headers of the masks are read, so that a run with wrong masks fails at its start.

        Args:
            frames: Name and undistorter of each image.

        Raises:
            InputError: For the first image whose mask is missing or of the wrong size, or if the vignette does not
                match.
        """
        for name, undistorter in frames:
            raw = undistorter.raw
            if self._masks is not None:
                self._masks.require_size(name, raw.width, raw.height)
            if self._vignette is not None:
                height, width = self._vignette.shape[:2]
                if abs(width * raw.height / (height * raw.width) - 1.0) > ASPECT_TOLERANCE:
                    what = self.source.vignette or f"the vignette of {self.images.path}"
                    raise InputError(
                        f"{what} is {width}x{height}, the images are {raw.width}x{raw.height}: "
                        "the vignette must show the whole image (source.vignette)"
                    )

    def read(self, name: str, undistorter: Undistorter, raw: NDArray[np.uint8] | None = None) -> Picture:
        """Read a frame, undistorted and at the working size.

        Args:
            name: Name of the image.
            undistorter: Undistorter of its camera.
            raw: The stored image (H0, W0, 3), if it is already decoded.

        Raises:
            InputError: If the image or its mask is unreadable.
        """
        raw = self.images.read(name) if raw is None else raw
        size, expected = raw.shape[1::-1], (undistorter.raw.width, undistorter.raw.height)
        if size != expected:
            raise UnreadableImageError(
                f"{self.images.path}: image {name} is now {size[0]}x{size[1]} instead of {expected[0]}x{expected[1]}; "
                "leave the images alone during a run"
            )
        image, mask = undistorter.image(raw, self.valid(name, raw))
        if self._vignette is None:
            return Picture(image, mask, None, undistorter.camera)
        vignette, lit = self._light(undistorter, self._vignette)
        return Picture(image, both_valid(mask, lit), vignette, undistorter.camera)

    def valid(self, name: str, raw: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
        """Return the valid pixels (H0, W0) of the stored image `raw`, or None if all are valid."""
        valid = both_valid(None if self._masks is None else self._masks.read(name), self.images.valid(name))
        if self.source.mask_colour is not None:
            valid = both_valid(valid, differs_from_colour(raw, self.source.mask_colour, self.source.mask_tolerance))
        return None if valid is None or valid.all() else valid

    def _light(
        self, undistorter: Undistorter, stored: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return the vignette of a camera's delivered images and the pixels with enough light, cached per camera."""
        if undistorter not in self._of_camera:
            vignette = undistorter.smooth(stored)
            lit = vignette.min(axis=2) >= LEAST_LIGHT
            vignette = np.clip(vignette, LEAST_LIGHT, 1.0)
            vignette.flags.writeable = False
            self._of_camera[undistorter] = vignette, lit
        return self._of_camera[undistorter]
