"""Counts how many other views find the same surface as a view."""
# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportIndexIssue=false

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.runtime.engine import ti
from pipelines.densify.depth.epipolar import plane_warp
from pipelines.surface.plane_sweep import LANES

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
    groups = (width + LANES - 1) // LANES
    for i in range(depth.shape[0] * groups):
        row, first = i // groups, i % groups * LANES
        v, lanes = row + 0.5, ti.min(LANES, width - first)
        agreed = ti.Vector([0.0] * LANES)
        for k in range(lanes):
            u, z = first + k + 0.5, depth[row, first + k]
            p = ti.Vector([0.0, 0.0, 0.0])
            for r in ti.static(range(3)):
                p[r] = z * (warp[r, 0] * u + warp[r, 1] * v + warp[r, 2]) + warp[r, 3]
            over = 1.0 / ti.max(p[2], 1e-12)
            x, y = p[0] * over, p[1] * over
            inside = (z > 0.0) & (p[2] > 0.0) & (x >= 0.0) & (y >= 0.0) & (x < other.shape[1]) & (y < other.shape[0])
            there = other[ti.cast(ti.select(inside, y, 0.0), ti.i32), ti.cast(ti.select(inside, x, 0.0), ti.i32)]
            agreed[k] = ti.select(inside & (ti.abs(p[2] - there) < tolerance * there), 1.0, 0.0)
        for k in range(lanes):
            count[row, first + k] = count[row, first + k] + agreed[k]
