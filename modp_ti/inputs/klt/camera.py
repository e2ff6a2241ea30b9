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

# Number of keyframes from which the focal length is estimated. Fewer keyframes fit almost any camera.
FOCAL_FROM = 6
# Focal length as a share of the image's longer side that is typical of phones, webcams and depth cameras.
TYPICAL_FOCAL = 0.85
# Accepted focal lengths as a share of the image's longer side, and radial coefficients.
LEAST_FOCAL, LARGEST_FOCAL = 0.4, 3.0
LARGEST_DISTORTION = 0.5
ADVICE = "source.intrinsics or a calibrated camera do better"


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
        return cls._of("PINHOLE", [camera.fx, camera.fy, camera.cx, camera.cy], camera.width, camera.height)

    @classmethod
    def radial(cls, focal: float, k: float, width: int, height: int) -> Lens:
        """A camera with one focal length [px], one radial coefficient and the principal point at the image centre."""
        return cls._of("SIMPLE_RADIAL", [focal, width / 2, height / 2, k], width, height)

    @classmethod
    def _of(cls, model: str, parameters: list[float], width: int, height: int) -> Lens:
        from modp_ti.files.quiet_pycolmap import pycolmap

        return cls(pycolmap.Camera(camera_id=1, model=model, params=parameters, width=width, height=height))

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

    @property
    def is_plausible(self) -> bool:
        """Whether focal length and distortion, with one radial coefficient, are those of a usual camera."""
        focal, _, _, k = (float(value) for value in self.camera.params)
        side = max(self.camera.width, self.camera.height)
        return LEAST_FOCAL < focal / side < LARGEST_FOCAL and abs(k) < LARGEST_DISTORTION

    def intrinsics(self, width: int, height: int) -> Intrinsics:
        """The intrinsics of the stored images of this size, with one radial coefficient."""
        focal, _, _, k = (float(value) for value in self.camera.params)
        focal *= width / self.camera.width
        distortion = Distortion(numerator=(k,)) if k else NO_DISTORTION
        return Intrinsics(PinholeCamera(focal, focal, width / 2, height / 2, width, height), distortion)


def estimation_note(found: Intrinsics, used: int) -> str:
    """Return the note on a camera that was estimated from `used` images."""
    k = found.distortion.numerator[0] if found.distortion.numerator else 0.0
    return (
        f"the camera is not known: focal length {found.camera.fx:.1f} px and radial distortion {k:.4f} are "
        f"estimated from {used} images; {ADVICE}"
    )


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
# without. 24 keyframes come to within 2 % of what 48 say. Closer keyframes estimate no better and take a camera's time.
WHILE_TRACKING = CameraRefinement((12, 24, 48), distortion_from=24, settles=True)
