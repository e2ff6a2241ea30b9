"""Similarities of the world: how places move when poses are revised.

A similarity is a (4, 4) matrix S_after_before, x -> s R x + t.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fields.geometry.se3 import inverse_se3, orthonormalised

__all__ = ["motion_around", "moved_points", "moved_pose", "scale_of"]


def scale_of(S: ArrayLike) -> NDArray[np.float64]:
    """Scale s () of a similarity (4, 4), or (N,) of N."""
    return np.cbrt(np.linalg.det(np.asarray(S, dtype=np.float64)[..., :3, :3]))


def motion_around(T_before: ArrayLike, T_after: ArrayLike, scale: float = 1.0) -> NDArray[np.float64]:
    """S_after_before (4, 4) of what a camera sees that was at `T_before` and is at `T_after` (T_camera_world, 4x4).

    In the camera's own frame everything stays where it was, `scale` times as far away. Exactly the identity where the
    pose is the same to the last bit and the scale is 1.
    """
    if scale == 1.0 and np.array_equal(T_before, T_after):
        return np.eye(4)
    return inverse_se3(T_after) @ np.diag([scale, scale, scale, 1.0]) @ np.asarray(T_before, dtype=np.float64)


def moved_pose(S: NDArray[np.float64], T_camera_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """T_camera_world (4, 4) of a camera that goes with a world that moves by S: it sees there what it saw before."""
    s = float(scale_of(S))
    T = orthonormalised(np.diag([s, s, s, 1.0]) @ T_camera_world @ np.linalg.inv(S))
    return T_camera_world.copy() if np.array_equal(S, np.eye(4)) else T


def moved_points(S: NDArray[np.float64], xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (N, 3) after the motion S (4, 4)."""
    return xyz.copy() if np.array_equal(S, np.eye(4)) else xyz @ S[:3, :3].T + S[:3, 3]
