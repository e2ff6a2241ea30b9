"""Counts how many other views find the same surface as a view."""
# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportIndexIssue=false

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.runtime.engine import ti
from pipelines.densify.depth.plane_sweep import plane_warp

__all__ = ["agreeing_views"]

IMAGE = ti.types.ndarray(dtype=ti.f32, ndim=2)
Placed = tuple[PinholeCamera, NDArray[np.float64], NDArray[np.float32]]


def agreeing_views(view: Placed, others: Iterable[Placed], tolerance: float) -> NDArray[np.float32]:
    """Return how many other views have the same depth at each pixel (H, W).

    Args:
        view: Camera, T_camera_world (4, 4) and depth (H, W), 0 where unknown.
        others: The same for each of the other views.
        tolerance: Largest relative difference of depths that are the same.
    """
    camera, T, depth = view
    count = np.zeros_like(depth)
    for other, T_other, there in others:
        _add(depth, plane_warp(camera, T, other, T_other).astype(np.float32), there, tolerance, count)
    return count


@ti.kernel
def _add(depth: IMAGE, warp: IMAGE, other: IMAGE, tolerance: ti.f32, count: IMAGE):
    width = depth.shape[1]
    for i in range(depth.shape[0] * width):
        row, column = i // width, i % width
        z = depth[row, column]
        p = ti.Vector([0.0, 0.0, 0.0])
        for r in ti.static(range(3)):
            p[r] = z * (warp[r, 0] * (column + 0.5) + warp[r, 1] * (row + 0.5) + warp[r, 2]) + warp[r, 3]
        if z > 0.0 and p[2] > 0.0:
            x, y = ti.floor(p[0] / p[2]), ti.floor(p[1] / p[2])
            if x >= 0.0 and y >= 0.0 and x < other.shape[1] and y < other.shape[0]:
                there = other[ti.cast(y, ti.i32), ti.cast(x, ti.i32)]
                if ti.abs(p[2] - there) < tolerance * there:
                    count[row, column] = count[row, column] + 1.0
