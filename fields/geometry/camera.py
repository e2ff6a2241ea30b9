"""`PinholeCamera`: an undistorted pinhole camera."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


def _number(value: float) -> float:
    """The value as a float; NaN if it is no number."""
    try:
        return math.nan if isinstance(value, str) else float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


@dataclass(frozen=True)
class PinholeCamera:
    """Pinhole intrinsics with OpenCV axes. The centre of pixel (row 0, column 0) is at (0.5, 0.5).

    There is no distortion model: sources undistort their images. Numbers of other types, such as NumPy's or a width of
    640.0, become plain ones.

    Attributes:
        fx: Horizontal focal length [px].
        fy: Vertical focal length [px].
        cx: Horizontal principal point [px].
        cy: Vertical principal point [px].
        width: Image width [px].
        height: Image height [px].

    Raises:
        ValueError: If the size or a focal length is not positive, the size is not whole, or a number is not finite.

    Example:
        camera = modp_ti.PinholeCamera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        fx, fy, cx, cy, width, height = (_number(value) for value in vars(self).values())
        if not (width >= 1 and height >= 1 and width.is_integer() and height.is_integer()):
            raise ValueError(f"camera size must be positive and whole, got {self.width}x{self.height}")
        if not (0 < fx < math.inf and 0 < fy < math.inf):
            raise ValueError(f"focal lengths must be positive numbers, got fx={self.fx}, fy={self.fy}")
        if not (math.isfinite(cx) and math.isfinite(cy)):
            raise ValueError(f"the principal point must be finite, got cx={self.cx}, cy={self.cy}")
        for name, value in zip(vars(self), (fx, fy, cx, cy, int(width), int(height)), strict=True):
            object.__setattr__(self, name, value)

    @property
    def focal(self) -> float:
        """Geometric mean of the focal lengths [px], f of Eq. 1. A pixel at depth d is d / f wide."""
        return float(np.sqrt(self.fx * self.fy))

    def matrix(self) -> NDArray[np.float64]:
        """Return the intrinsic matrix K (3, 3), for pixel centres at +0.5."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, width: int, height: int) -> PinholeCamera:
        """Return the camera of the image resampled to `width` x `height` pixels."""
        sx, sy = width / self.width, height / self.height
        return PinholeCamera(self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, width, height)

    def project(self, points_camera: NDArray[np.floating]) -> NDArray[np.float64]:
        """Project points (N, 3) in the camera frame, with z > 0, to pixels (N, 2) as (x, y)."""
        p = np.asarray(points_camera, dtype=np.float64)
        return np.stack([self.fx * p[:, 0] / p[:, 2] + self.cx, self.fy * p[:, 1] / p[:, 2] + self.cy], axis=1)

    def unproject(self, pixels: NDArray[np.floating], depth: NDArray[np.floating]) -> NDArray[np.float64]:
        """Unproject pixels (N, 2) as (x, y) at depth z (N,) to points (N, 3) in the camera frame."""
        uv = np.asarray(pixels, dtype=np.float64)
        z = np.asarray(depth, dtype=np.float64)
        return np.stack([(uv[:, 0] - self.cx) / self.fx * z, (uv[:, 1] - self.cy) / self.fy * z, z], axis=1)

    def contains(self, pixels: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return whether each of the pixels (N, 2) as (x, y) lies inside the image."""
        uv = np.asarray(pixels)
        return (uv[:, 0] >= 0) & (uv[:, 0] < self.width) & (uv[:, 1] >= 0) & (uv[:, 1] < self.height)
