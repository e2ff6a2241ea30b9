"""The one camera type: an undistorted pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["PinholeCamera"]


@dataclass(frozen=True)
class PinholeCamera:
    """Pinhole intrinsics in pixels. OpenCV axes; the centre of pixel (row 0, column 0) is (0.5, 0.5).

    Distortion is removed by the source before a frame reaches anything that takes this type.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera size must be positive, got {self.width}x{self.height}")
        if not (self.fx > 0 and self.fy > 0):
            raise ValueError(f"focal lengths must be positive, got fx={self.fx}, fy={self.fy}")

    @property
    def focal(self) -> float:
        """Geometric mean of the focal lengths [px]: the f of Eq. 1 (a pixel at depth d is d / f wide)."""
        return float(np.sqrt(self.fx * self.fy))

    def matrix(self) -> NDArray[np.float64]:
        """3x3 intrinsic matrix K for pixel centres at +0.5."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, width: int, height: int) -> PinholeCamera:
        """The camera of the same view resampled to `width` x `height` pixels."""
        sx, sy = width / self.width, height / self.height
        return PinholeCamera(self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, width, height)

    def project(self, points_camera: NDArray[np.floating]) -> NDArray[np.float64]:
        """Pixels (N, 2) as (x, y) of camera-frame points (N, 3) with z > 0."""
        p = np.asarray(points_camera, dtype=np.float64)
        return np.stack([self.fx * p[:, 0] / p[:, 2] + self.cx, self.fy * p[:, 1] / p[:, 2] + self.cy], axis=1)

    def unproject(self, pixels: NDArray[np.floating], depth: NDArray[np.floating]) -> NDArray[np.float64]:
        """Camera-frame points (N, 3) of pixels (N, 2) as (x, y) at depth z (N,)."""
        uv = np.asarray(pixels, dtype=np.float64)
        z = np.asarray(depth, dtype=np.float64)
        return np.stack([(uv[:, 0] - self.cx) / self.fx * z, (uv[:, 1] - self.cy) / self.fy * z, z], axis=1)

    def contains(self, pixels: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Which of the pixels (N, 2) as (x, y) lie inside the image."""
        uv = np.asarray(pixels)
        return (uv[:, 0] >= 0) & (uv[:, 0] < self.width) & (uv[:, 1] >= 0) & (uv[:, 1] < self.height)
