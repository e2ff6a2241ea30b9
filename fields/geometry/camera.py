"""`PinholeCamera`: an undistorted pinhole camera, and how small motions of it move its image."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

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

    def within(self, longest: int) -> PinholeCamera:
        """Return the camera for the same view with at most `longest` pixels on a side."""
        s = min(1.0, longest / max(self.width, self.height))
        return self.resized(max(round(s * self.width), 1), max(round(s * self.height), 1))

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


# Depths at which the metric samples a view [median depths].
NEAR_AND_FAR = (0.6, 1.6)


def pixel_jacobian(camera: PinholeCamera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return d pixel / d xi (N, 2, 6) of points (N, 3) before the camera, for a pose increment exp(xi) at xi = 0."""
    x, y, z = points.T
    fx, fy, zero = camera.fx / z, camera.fy / z, np.zeros(len(points))
    by_point = np.stack([fx, zero, -fx * x / z, zero, fy, -fy * y / z], axis=1).reshape(-1, 2, 3)
    # exp(xi) p = p + rho + omega x p
    turned = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    return np.concatenate([by_point, by_point @ turned], axis=2)


# Each keyframe has a depth of its own, and a refinement draws from all of them.
@lru_cache(maxsize=4096)
def pixel_metric(camera: PinholeCamera, median_depth: float) -> NDArray[np.float64]:
    """Coordinates of a pose's tangent in which step lengths are in pixels.

    With xi = W u, a step u moves the image by |u| px: the root mean square over a grid of pixels at two depths. This
    decorrelates small rotations and translations, which move the image in similar ways, and cancels the scale of the
    scene.

    Args:
        camera: Camera of the view.
        median_depth: Median depth of the view [scene units].

    Returns:
        W (6, 6), read-only.
    """
    across, down = (np.arange(0.1, 1.0, 0.2) * side for side in (camera.width, camera.height))
    grid = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    p = np.concatenate([camera.unproject(grid, np.full(len(grid), d * median_depth)) for d in NEAR_AND_FAR])
    J = pixel_jacobian(camera, p).reshape(-1, 6)
    W = np.linalg.inv(np.linalg.cholesky(J.T @ J / len(p))).T
    W.flags.writeable = False
    return W
