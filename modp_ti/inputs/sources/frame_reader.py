"""Reading of frames: undistorted image, validity mask and vignette."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.sources.masks import LEAST_LIGHT, MaskFolder, differs_from_colour, read_vignette
from modp_ti.inputs.sources.protocol import ImageSource
from modp_ti.inputs.sources.undistortion import Undistorter, both_valid

if TYPE_CHECKING:
    from modp_ti.config.settings import SourceSettings

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
