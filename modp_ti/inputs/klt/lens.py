"""The tracker's camera model: conversion between pixels and rays in the tracked images."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera

if TYPE_CHECKING:
    from modp_ti.files.quiet_pycolmap import pycolmap

__all__ = ["Lens"]


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
