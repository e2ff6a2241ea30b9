"""`ViewField` and `ProjectedGaussians`: the view of the current render, and what it sees in image space."""
# pyright: reportInvalidTypeForm=false

import numpy as np
import torch
from numpy.typing import ArrayLike

from fields.geometry.camera import PinholeCamera
from fields.runtime.backend import growing, on_gpu, without_waiting
from fields.runtime.compiled_kernel import CompiledKernel
from fields.runtime.engine import ti

# Projection is linearised up to this fraction of half the image outside the frame (1.3 tan(fov / 2), as in 3DGS).
FRUSTUM_MARGIN = 0.3


@ti.data_oriented
class ViewField:
    """Pose and intrinsics of one view.

    Attributes:
        rotation: Rotation (3, 3) of T_camera_world.
        translation: Translation (3,) of T_camera_world.
        focal: Focal lengths (2,) [px].
        centre: Principal point (2,) [px].
        limits: Bounds (left, right, top, bottom) of x/z and y/z within which the projection is linearised.
        near: Depth below which nothing is drawn [scene units].
        size: Width and height [px].
        pose: Rotation and translation (12,) as kernels take them.
        lens: Focal lengths, principal point, limits and near (9,) as kernels take them.
    """

    def __init__(self, builder: ti.FieldsBuilder, real=ti.f32) -> None:
        self.real = real
        self.dtype = np.float64 if real == ti.f64 else np.float32
        self.rotation = ti.Matrix.field(3, 3, real)
        self.translation = ti.Vector.field(3, real)
        self.focal = ti.Vector.field(2, real)
        self.centre = ti.Vector.field(2, real)
        self.limits = ti.Vector.field(4, real)
        self.near = ti.field(real)
        self.size = ti.Vector.field(2, ti.i32)
        builder.place(self.rotation, self.translation, self.focal, self.centre, self.limits, self.near, self.size)
        self._launch = CompiledKernel(self._set)
        self.pose: np.ndarray | torch.Tensor = np.zeros(12, dtype=self.dtype)
        self.lens: np.ndarray | torch.Tensor = np.zeros(9, dtype=self.dtype)
        self._lens_of: tuple[PinholeCamera, float] | None = None
        self.width = 0
        self.height = 0

    def set(self, camera: PinholeCamera, T_camera_world: ArrayLike | torch.Tensor, near: float) -> None:
        """Set the view: a pose (4, 4), and the depth below which nothing is drawn [scene units].

        On a GPU, the fields are written by the first kernel of the projection, and the pose may lie on the device: a
        tensor (12,) of its rotation and translation.
        """
        if isinstance(T_camera_world, torch.Tensor):
            self.pose = T_camera_world
        else:
            T = np.asarray(T_camera_world, dtype=np.float64)
            self.pose = without_waiting(np.concatenate([T[:3, :3].ravel(), T[:3, 3]]).astype(self.dtype))
        if self._lens_of != (camera, near):
            self._lens_of = camera, near
            self._set_lens(camera, near)
        if not on_gpu():
            self._launch(self.pose, self.lens, self.width, self.height)

    def _set_lens(self, camera: PinholeCamera, near: float) -> None:
        fx, fy, cx, cy, width, height = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
        margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * width / fx, FRUSTUM_MARGIN * 0.5 * height / fy
        limits = (-cx / fx - margin_x, (width - cx) / fx + margin_x, -cy / fy - margin_y, (height - cy) / fy + margin_y)
        self.width, self.height = width, height
        self.lens = without_waiting(np.array((fx, fy, cx, cy, *limits, near), dtype=self.dtype))

    @ti.kernel
    def _set(self, pose: ti.types.ndarray(), lens: ti.types.ndarray(), width: ti.i32, height: ti.i32):
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.write(pose, lens, width, height)

    @ti.func
    def write(self, pose: ti.template(), lens: ti.template(), width, height):
        """Write `pose` and `lens` to the fields."""
        for r in ti.static(range(3)):
            for c in ti.static(range(3)):
                self.rotation[None][r, c] = pose[3 * r + c]
            self.translation[None][r] = pose[9 + r]
        for c in ti.static(range(2)):
            self.focal[None][c] = lens[c]
            self.centre[None][c] = lens[2 + c]
        for c in ti.static(range(4)):
            self.limits[None][c] = lens[4 + c]
        self.near[None] = lens[8]
        self.size[None] = ti.Vector([width, height])


BLOCK = 1024


@ti.data_oriented
class ProjectedGaussians:
    """One slot per visible Gaussian, with the gradients of the values that compositing reads.

    Attributes:
        gaussian: Index in the `GaussianField`. On the CPU it increases with the slot, so that memory is read in order.
        order: The slots, nearest first. On a GPU, the slots are in that order themselves.
        mean: Pixel position (2).
        conic: Inverse 2D covariance (3) as (xx, xy, yy) [1/px^2].
        opacity: Opacity after the anti-aliasing compensation.
        colour: Colour (3) as seen from the view.
        depth: z in the camera frame [scene units].
        tangent: On a GPU, camera tangent xi = 0 (6), one copy per slot, so that its gradient is gathered without
            contention and in a fixed order. On the CPU, there is one per Gaussian, see `GaussianField`.
        first_pair: Index of the slot's first tile pair.
        end_pair: Index after the slot's last tile pair.
        seen: Number of slots, as read by kernels.
        count: Number of slots as known to the host. On a GPU, where it is not read back, this is an upper bound.
    """

    def __init__(self, builder: ti.FieldsBuilder, capacity: int, real=ti.f32) -> None:
        self.real = real
        self.capacity = -(-capacity // BLOCK) * BLOCK
        self.count = 0
        self.seen = ti.field(ti.i32)
        self.gaussian = ti.field(ti.i32)
        self.order = ti.field(ti.i32)
        self.first_pair = ti.field(ti.i32)
        self.end_pair = ti.field(ti.i32)
        self.mean = ti.Vector.field(2, real, needs_grad=True)
        self.conic = ti.Vector.field(3, real, needs_grad=True)
        self.opacity = ti.field(real, needs_grad=True)
        self.colour = ti.Vector.field(3, real, needs_grad=True)
        self.depth = ti.field(real, needs_grad=True)
        builder.place(self.seen)
        blocks = growing(builder, self.capacity // BLOCK)
        composited = (self.mean, self.conic, self.opacity, self.colour, self.depth)
        blocks.dense(ti.i, BLOCK).place(*composited)
        blocks.dense(ti.i, BLOCK).place(*(f.grad for f in composited))
        if on_gpu():
            self.tangent = ti.Vector.field(6, real, needs_grad=True)
            blocks.dense(ti.i, BLOCK).place(self.tangent, self.tangent.grad)
        blocks.dense(ti.i, BLOCK).place(self.gaussian, self.order, self.first_pair, self.end_pair)
