"""Parts of a plane sweep: the warp between two views at an inverse depth, and the peak between samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3

__all__ = ["plane_warp", "sub_sample_peak"]


def plane_warp(
    camera: PinholeCamera,
    T_camera_world: NDArray[np.float64],
    other: PinholeCamera,
    T_other_world: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Warp from a view to another one, for points at a given inverse depth.

    Args:
        camera: Camera of the view.
        T_camera_world: Pose (4, 4) of the view.
        other: Camera of the other view.
        T_other_world: Pose (4, 4) of the other view.

    Returns:
        [A b] (3, 4): pixel (x, y) at inverse depth w is at A (x, y, 1) + w b in the other view, homogeneous.
    """
    T = T_other_world @ inverse_se3(T_camera_world)
    K = other.matrix()
    return np.concatenate([K @ T[:3, :3] @ np.linalg.inv(camera.matrix()), (K @ T[:3, 3])[:, None]], axis=1)


def sub_sample_peak(left: NDArray, right: NDArray, curvature: NDArray) -> NDArray:
    """Offset (N,) of a parabola's peak from its middle sample, in samples and at most half of one.

    Args:
        left: Scores (N,) of the samples before the middle ones.
        right: Scores (N,) of the samples after them.
        curvature: 2 middle - left - right (N,), positive.
    """
    return np.clip((right - left) / (2.0 * curvature), -0.5, 0.5)
