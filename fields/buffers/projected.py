"""`ProjectedGaussians`: the visible Gaussians of one view in image space."""

import taichi as ti

from fields.runtime.backend import growing

__all__ = ["ProjectedGaussians"]

BLOCK = 1024


@ti.data_oriented
class ProjectedGaussians:
    """One slot per visible Gaussian, with the gradients of all that compositing reads.

    gaussian: index in the `GaussianField`, rising with the slot on the CPU, so that memory is read in its order. order:
    the slots, nearest first; on a GPU they are in that order themselves. mean (2): pixel position. conic (3): inverse
    2D covariance (xx, xy, yy) [1/px^2]. opacity: after the anti-aliasing compensation. colour (3), depth: z in the
    camera frame.
    tangent (6): a copy per slot of the camera tangent xi = 0, so that its gradient is gathered without contention
    and in a fixed order. first_pair, end_pair: index of the slot's first tile pair, and of the one behind its last.

    seen: how many slots there are, where kernels read it. count: the same as far as the host knows it: on a GPU, where
    nothing is read back, an upper bound.
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
        self.tangent = ti.Vector.field(6, real, needs_grad=True)
        builder.place(self.seen)
        blocks = growing(builder, self.capacity // BLOCK)
        composited = (self.mean, self.conic, self.opacity, self.colour, self.depth)
        blocks.dense(ti.i, BLOCK).place(*composited)
        blocks.dense(ti.i, BLOCK).place(*(f.grad for f in composited))
        blocks.dense(ti.i, BLOCK).place(self.tangent, self.tangent.grad)
        blocks.dense(ti.i, BLOCK).place(self.gaussian, self.order, self.first_pair, self.end_pair)
