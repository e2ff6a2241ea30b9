"""`Paint`: colours of surface points, blended from pictures that see them."""
# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportIndexIssue=false

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.runtime.engine import ti

# A picture sees a point if its depth there differs by at most this fraction.
VISIBLE = 0.02
# Weights of pictures are (cosine of the slant / depth) to this power. High powers prefer the sharpest picture.
PREFERENCE = 4.0

IMAGE = ti.types.ndarray(dtype=ti.f32, ndim=2)
COLOURS = ti.types.ndarray(dtype=ti.f32, ndim=3)


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
        _add(self._points, self._normals, K, T, depth, colour, self._sum)

    def colours(self) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
        """Return the colours (N, 3), and which of them (N,) some picture has seen."""
        weight = self._sum[:, 3:]
        return self._sum[:, :3] / np.maximum(weight, np.float32(1e-20)), weight[:, 0] > 0


@ti.kernel
def _add(points: IMAGE, normals: IMAGE, K: IMAGE, T: IMAGE, depth: IMAGE, colour: COLOURS, total: IMAGE):
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
