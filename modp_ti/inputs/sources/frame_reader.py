"""What a source knows of a frame: its undistorted image, which of its pixels count, how much light reached them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.masks import MaskFolder, differs_from_colour
from modp_ti.inputs.sources.protocol import ImageSource
from modp_ti.inputs.sources.undistortion import Undistorter
from modp_ti.inputs.sources.vignette import LEAST_LIGHT, read_vignette

if TYPE_CHECKING:
    from modp_ti.config.settings import SourceSettings

__all__ = ["FrameReader", "Picture"]

# A vignette is resized to its camera's image, and no further from its shape than rounding brings it.
ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class Picture:
    """image (H, W, 3) float32 in [0, 1]; mask (H, W) bool and vignette (H, W, 3) as in `TrackedFrame`."""

    image: NDArray[np.float32]
    mask: NDArray[np.bool_] | None
    vignette: NDArray[np.float32] | None


class FrameReader:
    """Reads frames of a source with what `source.masks`, `mask_colour` and `vignette` add to them.

    A vignette that the source itself has comes first: it is made of `source.vignette` where that is given.
    Raises InputError for a folder of masks or a vignette that cannot be used.
    """

    def __init__(self, images: ImageSource, source: SourceSettings) -> None:
        self.images = images
        self._source = source
        self._masks = None if source.masks is None else MaskFolder(source.masks)
        self._vignette = images.vignette
        if self._vignette is None and source.vignette is not None:
            self._vignette = read_vignette(source.vignette)
        self._of_camera: dict[Undistorter, tuple[NDArray[np.float32], NDArray[np.bool_]]] = {}

    def require_fitting(self, frames: Sequence[tuple[str, Undistorter]]) -> None:
        """Raises InputError for the first image whose mask is missing or misfits, or a vignette of another shape.

        Reads the headers only, so that a run fails at its start.
        """
        for name, undistorter in frames:
            raw = undistorter.raw
            if self._masks is not None:
                self._masks.require_size(name, raw.width, raw.height)
            if self._vignette is not None:
                height, width = self._vignette.shape[:2]
                if abs(width * raw.height / (height * raw.width) - 1.0) > ASPECT_TOLERANCE:
                    what = self._source.vignette or f"the vignette of {self.images.path}"
                    raise InputError(
                        f"{what} is {width}x{height}, the images are {raw.width}x{raw.height}: "
                        "the vignette must show the whole image (source.vignette)"
                    )

    def read(self, name: str, undistorter: Undistorter, raw: NDArray[np.uint8] | None = None) -> Picture:
        """The frame as the mapper takes it; raw: its stored image, where that is decoded already.

        Raises InputError for an image or a mask that is unreadable.
        """
        raw = self.images.read(name) if raw is None else raw
        image, mask = undistorter.image(raw, self.valid(name, raw))
        if self._vignette is None:
            return Picture(image, mask, None)
        vignette, lit = self._light(undistorter, self._vignette)
        return Picture(image, _both(mask, lit), vignette)

    def valid(self, name: str, raw: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
        """Which pixels of the stored image count; None where all do."""
        valid = _both(None if self._masks is None else self._masks.read(name), self.images.valid(name))
        if self._source.mask_colour is not None:
            valid = _both(valid, differs_from_colour(raw, self._source.mask_colour, self._source.mask_tolerance))
        return None if valid is None or valid.all() else valid

    def _light(
        self, undistorter: Undistorter, stored: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """The vignette of the camera's delivered images, and where it leaves enough light. One for all its frames.

        stored: the vignette (H, W, 3) of the stored images.
        """
        if undistorter not in self._of_camera:
            vignette = undistorter.smooth(stored)
            lit = vignette.min(axis=2) >= LEAST_LIGHT
            vignette = np.clip(vignette, LEAST_LIGHT, 1.0)
            vignette.flags.writeable = False
            self._of_camera[undistorter] = vignette, lit
        return self._of_camera[undistorter]


def _both(a: NDArray[np.bool_] | None, b: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    if a is None or b is None:
        return b if a is None else a
    return a & b
