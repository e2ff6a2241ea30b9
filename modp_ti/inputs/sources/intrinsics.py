"""Intrinsics of stored images, before they are undistorted and scaled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.inputs.sources.undistortion import Undistorter

if TYPE_CHECKING:
    from modp_ti.config.settings import IntrinsicsSettings

MAX_SIDE = 1 << 16
"""Largest side of an image [px]. No camera has more."""
# Larger values come from damaged files: focal lengths and principal points [px], and lens coefficients.
MAX_PIXELS_OF_FOCUS = 1e7
MAX_COEFFICIENT = 1e6

# A principal point this far from the middle, as a share of the image's side, probably belongs to another image size.
# Intrinsics of twice or half the size put it at 1 or 0.25 of the side.
OFF_CENTRE = 0.2


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of stored images.

    Attributes:
        camera: Pinhole camera at the stored size, with pixel centres at +0.5.
        distortion: Lens distortion.
        note: Remark for the user, shown if these intrinsics are used.
    """

    camera: PinholeCamera
    distortion: Distortion = NO_DISTORTION
    note: str | None = None

    def undistorter(self, scale: float) -> Undistorter:
        """Create the undistorter that takes stored images to the working size, scaled by `scale`."""
        return Undistorter(self.camera, self.distortion, scale)


def given_intrinsics(given: IntrinsicsSettings, width: int, height: int) -> Intrinsics:
    """Convert the user's `source.intrinsics` for stored images of this size.

    Args:
        given: The settings; `fx` must be set.
        width: Width of the stored images [px].
        height: Height of the stored images [px].

    Raises:
        InputError: If the intrinsics belong, or seem to belong, to another image size.
    """
    assert given.fx is not None
    if given.width is not None and (given.width, given.height) != (width, height):
        raise InputError(
            f"source.intrinsics are for {given.width}x{given.height}, the images are {width}x{height}: give those of "
            "the stored images (source.scale scales both)"
        )
    cx, cy = (width / 2 if given.cx is None else given.cx), (height / 2 if given.cy is None else given.cy)
    if given.width is None and max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > OFF_CENTRE:
        raise InputError(
            f"source.intrinsics: cx {cx:g}, cy {cy:g} lie far from the middle of the {width}x{height} images: give "
            "those of the stored size; where they are right, add width and height to them"
        )
    camera = PinholeCamera(given.fx, given.fy or given.fx, cx, cy, width, height)
    if given.fisheye:
        return Intrinsics(camera, Distortion((given.k1, given.k2, given.k3, given.k4), fisheye=True))
    return Intrinsics(camera, Distortion((given.k1, given.k2, given.k3), tangential=(given.p1, given.p2)))


def require_plausible(camera: PinholeCamera, lens: Distortion, what: str) -> tuple[PinholeCamera, Distortion]:
    """Check that a camera read from a file is plausible, and return it with its lens.

    Args:
        camera: The camera.
        lens: Its lens distortion.
        what: Start of the error message.

    Raises:
        InputError: If size, focal lengths, principal point or lens coefficients are out of range.
    """
    if max(camera.width, camera.height) > MAX_SIDE:
        raise InputError(f"{what}: images of {camera.width:.6g}x{camera.height:.6g} pixels: at most {MAX_SIDE} a side")
    if not (camera.fx > 1 / MAX_PIXELS_OF_FOCUS and camera.fy > 1 / MAX_PIXELS_OF_FOCUS):
        raise InputError(f"{what}: focal lengths of {camera.fx:g} and {camera.fy:g} pixels are none")
    if not all(abs(value) <= MAX_PIXELS_OF_FOCUS for value in (camera.fx, camera.fy, camera.cx, camera.cy)):
        raise InputError(f"{what}: fx, fy, cx or cy is no number of pixels that a camera has")
    coefficients = (*lens.numerator, *lens.denominator, *lens.tangential, *lens.prism)
    if not all(abs(value) <= MAX_COEFFICIENT for value in coefficients) or not 0.0 <= lens.fov < np.pi:
        raise InputError(f"{what}: the lens's coefficients are none that a lens has")
    return camera, lens
