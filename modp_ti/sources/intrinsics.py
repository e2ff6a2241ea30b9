"""Intrinsics of stored images, before they are undistorted and scaled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from fields.camera import PinholeCamera
from modp_ti.errors import InputError
from modp_ti.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.sources.undistortion import Undistorter

if TYPE_CHECKING:
    from modp_ti.settings import IntrinsicsSettings
    from modp_ti.sources.protocol import ImageSource

__all__ = ["Intrinsics", "given_intrinsics", "require_intrinsics"]

# A principal point this far from the middle, as a share of the image's side, is more likely of another image size.
# Intrinsics of twice or half the size put it at 1 or at 0.25.
OFF_CENTRE = 0.2


@dataclass(frozen=True)
class Intrinsics:
    """camera: pinhole part at the stored size, pixel centres at +0.5. distortion: the lens.

    note: what the user should know where they are relied upon.
    """

    camera: PinholeCamera
    distortion: Distortion = NO_DISTORTION
    note: str | None = None

    def undistorter(self, scale: float) -> Undistorter:
        """What takes the stored images to the working size."""
        return Undistorter(self.camera, self.distortion, scale)


def given_intrinsics(given: IntrinsicsSettings, width: int, height: int) -> Intrinsics:
    """`source.intrinsics`, which are given, for stored images of this size.

    Raises InputError where they belong to another size.
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


def require_intrinsics(images: ImageSource) -> Intrinsics:
    """The camera of the source, for a tracker that brings none; its note goes to the source's.

    Raises InputError where it is not known.
    """
    if images.intrinsics is None:
        raise InputError(
            f"{images.path}: the camera is not known: give source.intrinsics: {{fx: ..., fy: ..., cx: ..., cy: ...}} "
            "in pixels of the stored images"
        )
    if images.intrinsics.note is not None:
        images.notes.append(images.intrinsics.note)
    return images.intrinsics
