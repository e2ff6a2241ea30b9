"""Counts how many depth views see a surface where it is, and how many see through it."""
# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportIndexIssue=false

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.runtime.engine import ti

MATRIX = ti.types.ndarray(dtype=ti.f32, ndim=2)
COUNTS = ti.types.ndarray(dtype=ti.i32, ndim=1)
Placed = tuple[PinholeCamera, NDArray[np.float64], NDArray[np.float32]]


def supporting_views(
    points: NDArray[np.float64], views: Iterable[Placed], tolerance: float
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Count the views that see points, and those that see through them. The engine must have been started.

    A view before whose surface a point lies hidden counts as neither.

    Args:
        points: Points (N, 3) in the world frame.
        views: Camera, T_camera_world (4, 4) and depth (H, W), 0 where unknown, of each view.
        tolerance: Largest distance along z of a point from the depth of a view that sees it [scene units].

    Returns:
        Numbers (N,) of views that see each point, and that see through it.
    """
    places = np.ascontiguousarray(points, dtype=np.float32)
    seen, through = np.zeros(len(places), dtype=np.int32), np.zeros(len(places), dtype=np.int32)
    for camera, T, depth in views:
        K, pose = camera.matrix().astype(np.float32), np.ascontiguousarray(T, dtype=np.float32)
        _add(places, K, pose, np.ascontiguousarray(depth), tolerance, seen, through)
    return seen, through


@ti.kernel
def _add(
    points: MATRIX, K: MATRIX, T_camera_world: MATRIX, depth: MATRIX, tolerance: ti.f32, seen: COUNTS, through: COUNTS
):
    for i in range(points.shape[0]):
        p = ti.Vector([0.0, 0.0, 0.0])
        for r in ti.static(range(3)):
            p[r] = T_camera_world[r, 3]
            for c in ti.static(range(3)):
                p[r] += T_camera_world[r, c] * points[i, c]
        if p[2] > 0.0:
            u = ti.floor(K[0, 0] * p[0] / p[2] + K[0, 2])
            v = ti.floor(K[1, 1] * p[1] / p[2] + K[1, 2])
            if u >= 0.0 and v >= 0.0 and u < depth.shape[1] and v < depth.shape[0]:
                z = depth[ti.cast(v, ti.i32), ti.cast(u, ti.i32)]
                if z > 0.0:
                    if ti.abs(z - p[2]) <= tolerance:
                        seen[i] = seen[i] + 1
                    elif z > p[2]:
                        through[i] = through[i] + 1
