"""The tracker's camera: conversion between pixels and rays, and when an unknown one is refined with the map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.sources import NO_DISTORTION, Distortion, Intrinsics

if TYPE_CHECKING:
    from modp_ti.files.quiet_pycolmap import pycolmap


class Lens:
    """A camera with one of COLMAP's models.

    Args:
        camera: The camera in pycolmap, whose parameters a bundle adjustment may optimise.
    """

    def __init__(self, camera: pycolmap.Camera) -> None:
        self.camera = camera

    @classmethod
    def pinhole(cls, camera: PinholeCamera) -> Lens:
        """A camera without distortion."""
        from modp_ti.files.quiet_pycolmap import pycolmap

        parameters = [camera.fx, camera.fy, camera.cx, camera.cy]
        size = {"width": camera.width, "height": camera.height}
        return cls(pycolmap.Camera(camera_id=1, model="PINHOLE", params=parameters, **size))

    @classmethod
    def radial(cls, focal: float, k: float, width: int, height: int) -> Lens:
        """A camera with one focal length [px], one radial coefficient and the principal point at the image centre."""
        from modp_ti.files.quiet_pycolmap import pycolmap

        parameters = [focal, width / 2, height / 2, k]
        return cls(pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", params=parameters, width=width, height=height))

    @property
    def width(self) -> int:
        return int(self.camera.width)

    @property
    def height(self) -> int:
        return int(self.camera.height)

    @property
    def focal(self) -> float:
        """Mean focal length [px]."""
        return float(self.camera.mean_focal_length())

    def rays(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Undistorted normalised coordinates (N, 2) of pixels (N, 2), whose centres are at +0.5."""
        if len(pixels) == 0:
            return np.zeros((0, 2))
        return np.asarray(self.camera.cam_from_img(np.ascontiguousarray(pixels, dtype=np.float64)))

    def pixels(self, points_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (N, 2) of points (N, 3) in the camera frame; NaN for points that are not in front of the camera."""
        if len(points_camera) == 0:
            return np.zeros((0, 2))
        return np.asarray(self.camera.img_from_cam(np.ascontiguousarray(points_camera, dtype=np.float64)))


# Number of keyframes from which the focal length is estimated. Fewer keyframes fit almost any camera.
FOCAL_FROM = 6
ADVICE = "source.intrinsics or a calibrated camera do better"
# Focal length as a share of the image's longer side that is typical of phones, webcams and depth cameras.
TYPICAL_FOCAL = 0.85
# Accepted focal lengths as a share of the image's longer side, and radial coefficients.
LEAST_FOCAL, LARGEST_FOCAL = 0.4, 3.0
LARGEST_DISTORTION = 0.5


@dataclass(frozen=True)
class CameraRefinement:
    """When the camera is refined together with the map.

    Attributes:
        at: Numbers of keyframes at which it is refined.
        distortion_from: Number of keyframes from which the distortion is estimated too.
        settles: Whether the camera is in use meanwhile: implausible estimates are dropped, and it is final after the
            last number of `at`.
        share_of_shift: By what keyframes are closer to each other than with a known camera, until it is final.
    """

    at: tuple[int, ...]
    distortion_from: int
    settles: bool = False
    share_of_shift: float = 1.0


# For images that are tracked only to estimate the camera.
BEFORE_TRACKING = CameraRefinement((FOCAL_FROM, 12, 24, 48), distortion_from=12, share_of_shift=0.6)
# On redkitchen of 7-Scenes, whose focal length is 525 px, 6 keyframes say 497 and 12 say 465 with distortion and 545
# without. 24 keyframes come to within 2 % of what 48 say. Closer keyframes estimate no better (redkitchen 0.43 % of the
# path, with closer ones 0.43 %; the demo 0.03 % and 0.03 %), and take a camera's time: 35 instead of 29 ms a frame.
WHILE_TRACKING = CameraRefinement((12, 24, 48), distortion_from=24, settles=True)


def is_plausible(lens: Lens) -> bool:
    """Whether focal length and distortion of a lens with one radial coefficient are those of a usual camera."""
    focal, _, _, k = (float(value) for value in lens.camera.params)
    return LEAST_FOCAL < focal / max(lens.width, lens.height) < LARGEST_FOCAL and abs(k) < LARGEST_DISTORTION


def intrinsics_of(lens: Lens, size: tuple[int, int]) -> Intrinsics:
    """Convert a lens with one radial coefficient to the intrinsics of the stored images of `size` (width, height)."""
    width, height = size
    focal, _, _, k = (float(value) for value in lens.camera.params)
    focal *= width / lens.width
    distortion = Distortion(numerator=(k,)) if k else NO_DISTORTION
    return Intrinsics(PinholeCamera(focal, focal, width / 2, height / 2, width, height), distortion)


def estimation_note(found: Intrinsics, used: int) -> str:
    """Return the note on an estimated camera."""
    k = found.distortion.numerator[0] if found.distortion.numerator else 0.0
    return (
        f"the camera is not known: focal length {found.camera.fx:.1f} px and radial distortion {k:.4f} are "
        f"estimated from {used} images; {ADVICE}"
    )
