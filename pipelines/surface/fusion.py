"""The surface of a finished map from depth views: distance field, colours, and how many views support a point."""
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.runtime.engine import ti

IMAGE = ti.types.ndarray(dtype=ti.f32, ndim=2)
COLOURS = ti.types.ndarray(dtype=ti.f32, ndim=3)
VALUES = ti.types.ndarray(dtype=ti.f32, ndim=1)


@ti.kernel
def integrate(
    blocks: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (B, 3) first voxel of each block
    rows: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (B,) first row of each block in the field
    offsets: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (V, 3) voxels of a block from its first one
    voxel: ti.f32,
    K: IMAGE,
    T_camera_world: IMAGE,
    depth: IMAGE,  # 0 where unknown
    colour: COLOURS,
    truncation: ti.f32,
    farthest: ti.f32,
    free_weight: ti.f32,
    tsdf: VALUES,
    weight: VALUES,
    colours: IMAGE,
):
    """Average min((depth - z) / truncation, 1) with the voxels' values, unless it is below -1.

    A voxel that lies more than the truncation before the surface is seen to be free. Its view counts `free_weight`
    times, so that wrong surfaces in free space disappear.
    """
    each, height, width = offsets.shape[0], depth.shape[0], depth.shape[1]
    for i in range(blocks.shape[0] * each):
        b, j = i // each, i % each
        p = ti.Vector([0.0, 0.0, 0.0])
        for r in ti.static(range(3)):
            p[r] = T_camera_world[r, 3]
            for c in ti.static(range(3)):
                p[r] += T_camera_world[r, c] * voxel * (blocks[b, c] + offsets[j, c])
        if p[2] > 0.0:
            u = ti.floor(K[0, 0] * p[0] / p[2] + K[0, 2])
            v = ti.floor(K[1, 1] * p[1] / p[2] + K[1, 2])
            if u >= 0.0 and v >= 0.0 and u < width and v < height:
                x, y = ti.cast(u, ti.i32), ti.cast(v, ti.i32)
                z, w = depth[y, x], 1.0
                distance = (z - p[2]) / truncation
                if z > 0.0 and z < farthest and distance >= -1.0:
                    if distance > 1.0:
                        distance = 1.0
                        w = free_weight
                    at = rows[b] + j
                    before = weight[at]
                    share = w / ti.max(before + w, 1e-12)
                    tsdf[at] = tsdf[at] + share * (distance - tsdf[at])
                    weight[at] = before + w
                    for c in ti.static(range(3)):
                        colours[at, c] = colours[at, c] + share * (colour[y, x, c] - colours[at, c])


# A picture sees a point if its depth there differs by at most this fraction.
VISIBLE = 0.02
# Weights of pictures are (cosine of the slant / depth) to this power. High powers prefer the sharpest picture.
PREFERENCE = 4.0


class Paint:
    """Blends the colours of surface points.

    Args:
        points: (N, 3) points.
        normals: (N, 3) unit normals.
    """

    def __init__(self, points: NDArray[np.floating], normals: NDArray[np.floating]) -> None:
        self._points = np.ascontiguousarray(points, dtype=np.float32)
        self._normals = np.ascontiguousarray(normals, dtype=np.float32)
        self._sum = np.zeros((len(points), 4), dtype=np.float32)

    def add(
        self,
        camera: PinholeCamera,
        T_camera_world: NDArray[np.float64],
        depth: NDArray[np.float32],
        colour: NDArray[np.float32],
    ) -> None:
        """Add a picture.

        Args:
            camera: The picture's camera.
            T_camera_world: (4, 4) pose.
            depth: (H, W) depth of the surface; a point behind it is hidden.
            colour: (H, W, 3) in [0, 1].
        """
        K, T = camera.matrix().astype(np.float32), np.ascontiguousarray(T_camera_world, dtype=np.float32)
        _blend(self._points, self._normals, K, T, depth, colour, self._sum)

    def colours(self) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
        """Return the colours (N, 3), and which of them (N,) some picture has seen."""
        weight = self._sum[:, 3:]
        return self._sum[:, :3] / np.maximum(weight, np.float32(1e-20)), weight[:, 0] > 0


@ti.kernel
def _blend(points: IMAGE, normals: IMAGE, K: IMAGE, T: IMAGE, depth: IMAGE, colour: COLOURS, total: IMAGE):
    right, bottom = depth.shape[1] - 1, depth.shape[0] - 1
    for i in range(points.shape[0]):
        p, n = ti.Vector([0.0, 0.0, 0.0]), ti.Vector([0.0, 0.0, 0.0])
        for r in ti.static(range(3)):
            p[r] = T[r, 3]
            for c in ti.static(range(3)):
                p[r] += T[r, c] * points[i, c]
                n[r] += T[r, c] * normals[i, c]
        # Seen from outside, the normal points to the camera.
        facing = -n.dot(p) / ti.max(p.norm(), 1e-12)
        if p[2] > 0.0 and facing > 0.0:
            x, y = K[0, 0] * p[0] / p[2] + K[0, 2] - 0.5, K[1, 1] * p[1] / p[2] + K[1, 2] - 0.5
            if x >= 0.0 and y >= 0.0 and x < right and y < bottom:
                x0, y0 = ti.cast(x, ti.i32), ti.cast(y, ti.i32)
                s, t = x - x0, y - y0
                visible = False
                for dy, dx in ti.static(ti.ndrange(2, 2)):
                    visible = visible or ti.abs(depth[y0 + dy, x0 + dx] - p[2]) < VISIBLE * p[2]
                if visible:
                    w = (facing / p[2]) ** PREFERENCE
                    for c in ti.static(range(3)):
                        above = colour[y0, x0, c] * (1.0 - s) + colour[y0, x0 + 1, c] * s
                        below = colour[y0 + 1, x0, c] * (1.0 - s) + colour[y0 + 1, x0 + 1, c] * s
                        total[i, c] = total[i, c] + w * (above * (1.0 - t) + below * t)
                    total[i, 3] = total[i, 3] + w


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
        _count_support(places, K, pose, np.ascontiguousarray(depth), tolerance, seen, through)
    return seen, through


@ti.kernel
def _count_support(
    points: IMAGE, K: IMAGE, T_camera_world: IMAGE, depth: IMAGE, tolerance: ti.f32, seen: COUNTS, through: COUNTS
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
