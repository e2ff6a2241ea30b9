"""The photometric model: image = (A colour + b) * vignette, and its gradients.

A (3, 3) and b (3,) are a frame's exposure. The vignette is the fraction of the light that reaches each pixel. With the
gradient g of the loss with respect to the image and h = vignette * g, the gradients are
    d colour = A^T h,   d A = sum over the pixels of h colour^T,   d b = sum of h.
"""
# pyright: reportInvalidTypeForm=false

import numpy as np

from fields.buffers.images import PAD, ImageBuffers
from fields.runtime.compiled_kernel import HANDED_OUT, CompiledKernel
from fields.runtime.engine import ti
from pipelines.render.formulas import PhotometricBuffers

# Eight rows per chunk, see `fields.runtime.compiled_kernel`.
SPREAD = HANDED_OUT // 8


@ti.data_oriented
class Photometric(PhotometricBuffers):
    """Applies exposure and vignette to `images.colour` in place, and propagates `images.colour_grad` back."""

    def __init__(self, images: ImageBuffers) -> None:
        super().__init__(images)
        self._sums = np.zeros((images.max_height, 12))
        self._apply, self._apply_back = CompiledKernel(self._forward), CompiledKernel(self._backward)

    def exposure_gradient(self) -> np.ndarray:
        # Sum the rows in a fixed order, so that two runs agree bit for bit.
        return self._sums[: self.images.height].sum(axis=0).reshape(3, 4)

    def _develop(self) -> None:
        self._apply(self.images.width, self.images.height, self._exposure)

    def _undevelop(self) -> None:
        self._apply_back(self.images.width, self.images.height, self._exposure, self._sums)

    @ti.kernel
    def _forward(self, width: ti.i32, height: ti.i32, exposure: ti.types.ndarray(dtype=ti.f64, ndim=2)):
        for spread in range(height * SPREAD):
            if spread % SPREAD == 0:
                self._forward_row(spread // SPREAD, width, exposure)

    @ti.func
    def _forward_row(self, y, width, exposure: ti.template()):
        plane = ti.static(self.images.plane)
        row = (y + PAD) * self.images.stride + PAD
        E = ti.Matrix([[ti.cast(exposure[i, j], self.real) for j in range(4)] for i in range(3)])
        # A first access of each tree outside the loop makes Taichi fetch its root once, and not at every pixel.
        self.rendered[row], self.images.colour[row] = self.rendered[row], self.images.colour[row]
        for x in range(row, row + width):
            red, green, blue = self.images.colour[x], self.images.colour[plane + x], self.images.colour[2 * plane + x]
            self.rendered[x], self.rendered[plane + x], self.rendered[2 * plane + x] = red, green, blue
            for c in ti.static(range(3)):
                developed = E[c, 0] * red + E[c, 1] * green + E[c, 2] * blue + E[c, 3]
                self.images.colour[c * plane + x] = developed * self.vignette[c * plane + x]

    @ti.kernel
    def _backward(
        self,
        width: ti.i32,
        height: ti.i32,
        exposure: ti.types.ndarray(dtype=ti.f64, ndim=2),
        sums: ti.types.ndarray(dtype=ti.f64, ndim=2),
    ):
        for spread in range(height * SPREAD):
            if spread % SPREAD == 0:
                self._backward_row(spread // SPREAD, width, exposure, sums)

    @ti.func
    def _backward_row(self, y, width, exposure: ti.template(), sums: ti.template()):
        plane = ti.static(self.images.plane)
        row = (y + PAD) * self.images.stride + PAD
        E = ti.Matrix([[ti.cast(exposure[i, j], self.real) for j in range(4)] for i in range(3)])
        self.rendered[row], self.images.colour[row] = self.rendered[row], self.images.colour[row]
        total = ti.Matrix.zero(self.real, 3, 4)
        for x in range(row, row + width):
            red, green, blue = self.rendered[x], self.rendered[plane + x], self.rendered[2 * plane + x]
            h = ti.Vector([self.images.colour_grad[c * plane + x] * self.vignette[c * plane + x] for c in range(3)])
            for c in ti.static(range(3)):
                total[c, 0] += h[c] * red
                total[c, 1] += h[c] * green
                total[c, 2] += h[c] * blue
                total[c, 3] += h[c]
                self.images.colour_grad[c * plane + x] = E[0, c] * h[0] + E[1, c] * h[1] + E[2, c] * h[2]
                self.images.colour[c * plane + x] = self.rendered[c * plane + x]
        for i, j in ti.static(ti.ndrange(3, 4)):
            sums[y, 4 * i + j] = total[i, j]
