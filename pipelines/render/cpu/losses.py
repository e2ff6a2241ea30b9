"""Photometric loss (1 - w) L1 + w (1 - SSIM) with its image gradient.

SSIM [Wang 2004] uses an 11x11 Gaussian window (sigma 1.5) with zero padding, as in 3DGS. With the local moments
mu = G*x, e_xx = G*xx, e_xy = G*xy, the gradient is
    d S / d x = G*(dS/dmu) + 2 x (G*(dS/de_xx)) + y (G*(dS/de_xy)).
Both convolutions are separable and work on strips of rows whose scratch memory stays in the cache. S depends on e_xx
and e_yy only through their sum, which saves one convolution.
"""
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOptionalCall=false, reportOptionalSubscript=false

import numpy as np
from numpy.typing import NDArray

from fields.buffers.images import PAD, SCRATCH_ROWS, STRIPS, ImageBuffers
from fields.runtime.compiled_kernel import HANDED_OUT, CompiledKernel, CompiledLoop
from fields.runtime.engine import ti
from pipelines.render.formulas import C1, C2, RADIUS, LossValues, window_weights

# Four strips of a channel, or four rows, per chunk (see `fields.runtime.compiled_kernel`).
SPREAD = HANDED_OUT // 4


@ti.func
def place(index):
    """Mask a field index to [0, 2^30).

    With this and `extent`, LLVM knows that 32-bit indices do not overflow, and folds the constant offsets of a window
    into the loads. Otherwise it computes each address with two instructions.
    """
    return index & 0x3FFFFFFF


@ti.func
def extent(pixels):
    """Mask the length of a row to less than 2^16, see `place`."""
    return pixels & 0xFFFF


@ti.data_oriented
class PhotometricLoss:
    """Compares `images.colour` with `images.reference`. Its values are available at once."""

    lag = 0

    def __init__(self, images: ImageBuffers) -> None:
        self.images = images
        self.real = images.real
        self.weights = window_weights()
        self._sums = np.zeros((3 * STRIPS, 4), dtype=np.float64)
        self._mask, self._compare = CompiledLoop(self._mask_rows, 8), CompiledKernel(self._compare_strips)
        self._differentiate = CompiledKernel(self._differentiate_strips)

    def forward(self, rgba: NDArray[np.uint8]) -> LossValues:
        self.images.set_reference(rgba)
        width, height = self.images.width, self.images.height
        if self.images.masked:
            self._mask(width * height, width, height)
        self._sums[:] = 0.0
        self._compare(width, height, 4, self._sums)
        sums = self._sums.sum(axis=0)
        return LossValues(lambda: sums)

    def send(self) -> None:
        pass  # nothing to wait for

    def backward(self, ssim_weight: float, scale: float = 1.0) -> None:
        count = max(float(self._sums[:, 3].sum()), 1.0)
        self._differentiate(
            self.images.width,
            self.images.height,
            scale * (1.0 - ssim_weight) / count,
            -scale * ssim_weight / count,
            3,
        )

    @ti.kernel
    def _mask_rows(self, alone: ti.template(), width: ti.i32, height: ti.i32):
        ti.loop_config(serialize=alone)
        for i in range(height * SPREAD):
            if i % SPREAD == 0:
                row = (i // SPREAD + PAD) * self.images.stride + PAD
                for c in range(3):
                    for x in range(row, row + width):
                        r = self.images.reference[c * self.images.plane + x]
                        d = self.images.colour[c * self.images.plane + x] - r
                        self.images.colour[c * self.images.plane + x] = r + d * self.images.valid[x]

    @ti.func
    def _smooth_rows(self, first, smooth, rows, width):
        """Convolve the `rows` scratch rows from `first` on horizontally, into those from `smooth` on.

        One row at a time, since LLVM does not vectorise loops with more than about 25 addresses.
        """
        for q in range(rows):
            source = place(first + q * self.images.stride + PAD - RADIUS)
            target = place(smooth + q * self.images.stride)
            for x in range(extent(width)):
                total = ti.cast(0.0, self.real)
                for k in ti.static(range(2 * RADIUS + 1)):
                    total += self.weights[k] * self.images.rows[source + x + k]
                self.images.rows[target + x] = total

    @ti.kernel
    def _compare_strips(self, width: ti.i32, height: ti.i32, moments: ti.i32, sums: ti.types.ndarray()):
        # moments is always 4, but is passed as an argument. As a constant, LLVM would unroll the loop over it, which
        # lengthens the compilation at every start of a process without making the kernel faster.
        for i in range((3 * STRIPS) * SPREAD):
            if i % SPREAD == 0:
                self._compare_unit(i // SPREAD, width, height, moments, sums)

    @ti.func
    def _compare_unit(self, unit, width, height, moments, sums: ti.template()):
        stride, plane = ti.static(self.images.stride, self.images.plane)
        channel = unit // STRIPS * plane
        partial = unit // STRIPS * 3 * plane
        strip = unit % STRIPS
        scratch = unit * SCRATCH_ROWS * stride
        # A first access outside the loop makes Taichi fetch the tree's root once, and not at every pixel.
        self.images.rows[scratch] = 0.0
        zero = ti.cast(0.0, self.real)
        l1, ssim, square, count = zero, zero, zero, zero
        for y in range(height * strip // STRIPS, height * (strip + 1) // STRIPS):
            self._moments_of_row(channel + (y + PAD - RADIUS) * stride, scratch, width)
            smooth = place(scratch + 4 * stride)
            self._smooth_rows(scratch, smooth, moments, width)
            row = place((y + PAD) * stride + PAD)
            for x in range(extent(width)):
                mu_x, mu_y = self.images.rows[smooth + x], self.images.rows[smooth + stride + x]
                mean_square = mu_x * mu_x + mu_y * mu_y
                variances = self.images.rows[smooth + 2 * stride + x] - mean_square
                covariance = self.images.rows[smooth + 3 * stride + x] - mu_x * mu_y
                # S = (A1 A2) / (B1 B2)
                A1, B1 = 2.0 * mu_x * mu_y + C1, mean_square + C1
                A2, B2 = 2.0 * covariance + C2, variances + C2
                inv = 1.0 / (B1 * B2)
                S = A1 * A2 * inv
                valid = self.images.valid[row + x]
                d_mu = 2.0 * inv * (mu_y * (A2 - A1) - mu_x * S * (B2 - B1))
                self.images.ssim_partial[partial + row + x] = d_mu * valid
                self.images.ssim_partial[partial + plane + row + x] = -S * B1 * inv * valid
                self.images.ssim_partial[partial + 2 * plane + row + x] = 2.0 * A1 * inv * valid
                self.images.ssim[channel + row + x] = S
                d = self.images.colour[channel + row + x] - self.images.reference[channel + row + x]
                l1 += ti.abs(d)
                square += d * d
                ssim += S * valid
                count += valid
        sums[unit, 0] = l1
        sums[unit, 1] = ssim
        sums[unit, 2] = square
        sums[unit, 3] = count

    @ti.func
    def _moments_of_row(self, first, scratch, width):
        """Convolve x, y, xx + yy and xy vertically over the rows from `first` on."""
        stride = ti.static(self.images.stride)
        top, target = place(first), place(scratch)
        for x in range(extent(width + 2 * PAD)):
            total = ti.Vector.zero(self.real, 4)
            for k in ti.static(range(2 * RADIUS + 1)):
                a = self.images.colour[top + k * stride + x]
                b = self.images.reference[top + k * stride + x]
                wa, wb = self.weights[k] * a, self.weights[k] * b
                total += ti.Vector([wa, wb, wa * a + wb * b, wa * b])
            for q in ti.static(range(4)):
                self.images.rows[target + q * stride + x] = total[q]

    @ti.kernel
    def _differentiate_strips(
        self, width: ti.i32, height: ti.i32, l1_scale: ti.f64, ssim_scale: ti.f64, partials: ti.i32
    ):
        # partials is always 3, but not a constant, for the reason given in `_compare_strips`.
        for i in range((3 * STRIPS) * SPREAD):
            if i % SPREAD == 0:
                self._differentiate_unit(i // SPREAD, width, height, l1_scale, ssim_scale, partials)

    @ti.func
    def _differentiate_unit(self, unit, width, height, l1_scale, ssim_scale, partials):
        stride, plane = ti.static(self.images.stride, self.images.plane)
        channel = unit // STRIPS * plane
        partial = unit // STRIPS * 3 * plane
        strip = unit % STRIPS
        scratch = place(unit * SCRATCH_ROWS * stride)
        self.images.rows[scratch] = 0.0
        by_l1, by_ssim = ti.cast(l1_scale, self.real), ti.cast(ssim_scale, self.real)
        for y in range(height * strip // STRIPS, height * (strip + 1) // STRIPS):
            for q in range(partials):
                top = place(partial + q * plane + (y + PAD - RADIUS) * stride)
                target = place(scratch + q * stride)
                for x in range(extent(width + 2 * PAD)):
                    total = ti.cast(0.0, self.real)
                    for k in ti.static(range(2 * RADIUS + 1)):
                        total += self.weights[k] * self.images.ssim_partial[top + k * stride + x]
                    self.images.rows[target + x] = total
            smooth = place(scratch + 3 * stride)
            self._smooth_rows(scratch, smooth, partials, width)
            row = place((y + PAD) * stride + PAD)
            for x in range(extent(width)):
                a = self.images.colour[channel + row + x]
                b = self.images.reference[channel + row + x]
                by_mean = self.images.rows[smooth + x]
                by_square = self.images.rows[smooth + stride + x]
                by_product = self.images.rows[smooth + 2 * stride + x]
                sign = ti.select(a > b, 1.0, ti.select(a < b, -1.0, 0.0))
                gradient = by_l1 * sign + by_ssim * (by_mean + 2.0 * a * by_square + b * by_product)
                self.images.colour_grad[channel + row + x] = gradient * self.images.valid[row + x]
