"""`ProjectedGaussians`: the visible Gaussians of one view in image space."""

from fields.runtime.backend import growing, on_gpu
from fields.runtime.engine import ti

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
