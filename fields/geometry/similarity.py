"""Similarity transforms of the world, for the revision of poses.

A similarity is a matrix S_after_before (4, 4), x -> s R x + t.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fields.geometry.se3 import inverse_se3, orthonormalised


def scale_of(S: ArrayLike) -> NDArray[np.float64]:
    """Scale s of a similarity (4, 4), or scales (N,) of N similarities (N, 4, 4)."""
    return np.cbrt(np.linalg.det(np.asarray(S, dtype=np.float64)[..., :3, :3]))


def motion_around(T_before: ArrayLike, T_after: ArrayLike, scale: float = 1.0) -> NDArray[np.float64]:
    """Similarity of the world around a camera whose pose is revised.

    In the camera frame, everything keeps its direction and moves to `scale` times its distance.

    Args:
        T_before: Former pose T_camera_world (4, 4).
        T_after: Revised pose T_camera_world (4, 4).
        scale: Change of scale.

    Returns:
        S_after_before (4, 4), exactly the identity if the poses are bit-identical and the scale is 1.
    """
    if scale == 1.0 and np.array_equal(T_before, T_after):
        return np.eye(4)
    return inverse_se3(T_after) @ np.diag([scale, scale, scale, 1.0]) @ np.asarray(T_before, dtype=np.float64)


def moved_pose(S: NDArray[np.float64], T_camera_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """T_camera_world (4, 4) of a camera that moves with the world by S (4, 4), so that its image stays the same."""
    if np.array_equal(S, np.eye(4)):
        return T_camera_world.copy()
    s = float(scale_of(S))
    return orthonormalised(np.diag([s, s, s, 1.0]) @ T_camera_world @ np.linalg.inv(S))


def moved_points(S: NDArray[np.float64], xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Apply a similarity S (4, 4) to points (N, 3)."""
    return xyz.copy() if np.array_equal(S, np.eye(4)) else xyz @ S[:3, :3].T + S[:3, 3]
