"""`ViewField`: the camera that is being rendered, where kernels can read it."""

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike

from fields.camera import PinholeCamera

__all__ = ["ViewField"]

# Projection linearises at most this share of half the image outside the frame (1.3 tan(fov / 2), as 3DGS does).
FRUSTUM_MARGIN = 0.3
# By value: an array would be copied to a GPU and back, and the host wait for it.
VALUES = ti.types.vector(21, ti.f64)


@ti.data_oriented
class ViewField:
    """Pose and intrinsics of one view: rotation and translation of T_camera_world, focal lengths, centre, size.

    `limits` are the bounds of x/z and y/z (left, right, top, bottom) between which the projection is linearised;
    `near` is the depth below which nothing is drawn, in scene units.
    """

    def __init__(self, builder: ti.FieldsBuilder, real=ti.f32) -> None:
        self.real = real
        self.rotation = ti.Matrix.field(3, 3, real)
        self.translation = ti.Vector.field(3, real)
        self.focal = ti.Vector.field(2, real)
        self.centre = ti.Vector.field(2, real)
        self.limits = ti.Vector.field(4, real)
        self.near = ti.field(real)
        self.size = ti.Vector.field(2, ti.i32)
        builder.place(self.rotation, self.translation, self.focal, self.centre, self.limits, self.near, self.size)
        self.width = 0
        self.height = 0

    def set(self, camera: PinholeCamera, T_camera_world: ArrayLike, near: float) -> None:
        """Look through `camera` from `T_camera_world` (4, 4)."""
        T = np.asarray(T_camera_world, dtype=np.float64)
        margin_x = FRUSTUM_MARGIN * 0.5 * camera.width / camera.fx
        margin_y = FRUSTUM_MARGIN * 0.5 * camera.height / camera.fy
        values = np.concatenate(
            [
                T[:3, :3].ravel(),
                T[:3, 3],
                [camera.fx, camera.fy, camera.cx, camera.cy],
                [-camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x],
                [-camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y],
                [near],
            ]
        )
        self.width, self.height = camera.width, camera.height
        self._set(values, camera.width, camera.height)

    @ti.kernel
    def _set(self, values: VALUES, width: ti.i32, height: ti.i32):
        for _ in range(1):
            for r in ti.static(range(3)):
                for c in ti.static(range(3)):
                    self.rotation[None][r, c] = ti.cast(values[3 * r + c], self.real)
                self.translation[None][r] = ti.cast(values[9 + r], self.real)
            for c in ti.static(range(2)):
                self.focal[None][c] = ti.cast(values[12 + c], self.real)
                self.centre[None][c] = ti.cast(values[14 + c], self.real)
            for c in ti.static(range(4)):
                self.limits[None][c] = ti.cast(values[16 + c], self.real)
            self.near[None] = ti.cast(values[20], self.real)
            self.size[None] = ti.Vector([width, height])
