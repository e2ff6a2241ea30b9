"""The photometric loss on a GPU: one block per tile and channel, with both SSIM windows in shared memory.

The formulas are those of `pipelines/render/cpu/losses.py`. The sums stay on the device, where the backward pass reads
the number of valid pixels. The host reads the values later.
"""
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false

from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from fields.buffers.device_pairs import TILE_HEIGHT, TILE_PIXELS, TILE_WIDTH, tile_count
from fields.buffers.images import PAD, ImageBuffers
from fields.runtime.backend import torch_device
from fields.runtime.compiled_kernel import AsyncReadback, CompiledKernel
from fields.runtime.engine import ti
from pipelines.render.formulas import C1, C2, RADIUS, LossValues, window_weights
from pipelines.render.gpu.reductions import THREAD_BITS, THREADS, partial_sums, sum_blocks, sum_over_block

# Side of a tile with the border that its windows reach.
SIDE = TILE_WIDTH + 2 * RADIUS
HALO = SIDE * SIDE
BAND = SIDE * TILE_WIDTH
ROW_BITS = TILE_WIDTH.bit_length() - 1
# Number of evaluations whose values share one tensor and are copied to the host together.
ROWS = 64

NUMBERS = ti.types.ndarray(dtype=ti.f32, ndim=1)
assert THREADS == TILE_PIXELS == TILE_WIDTH * TILE_HEIGHT


class _Values:
    """The sums of `ROWS` evaluations on the device, and their copy to the host."""

    def __init__(self) -> None:
        self.sums = torch.zeros((ROWS, 4), dtype=torch.float32, device=torch_device())
        self.written = 0
        self._sent = 0
        self._late: AsyncReadback | None = None

    def send(self) -> None:
        """Start the copy to the host if there are new values."""
        if self._sent < self.written:
            self._copy()

    def row(self, i: int) -> np.ndarray:
        """The sums (4,) of evaluation i. Waits for the copy if it has not finished."""
        late = self._copy() if self._late is None or i >= self._sent else self._late
        return late.numpy()[i].astype(np.float64)

    def _copy(self) -> AsyncReadback:
        self._late, self._sent = AsyncReadback(self.sums), self.written
        return self._late


@ti.data_oriented
class DevicePhotometricLoss:
    """Compares `images.colour` with a reference image. Its values are read asynchronously."""

    lag = 1

    def __init__(self, images: ImageBuffers) -> None:
        self.images = images
        self.weights = window_weights()
        self._partial = partial_sums(3 * tile_count(images.max_width, images.max_height), 4)
        self._totals = torch.zeros(4, dtype=torch.float32, device=torch_device())
        self._compare, self._differentiate = (
            CompiledKernel(self._compare_tiles),
            CompiledKernel(self._differentiate_tiles),
        )
        self._values = _Values()

    def forward(self, rgba: NDArray[np.uint8]) -> LossValues:
        if self._values.written == ROWS:
            self._values = _Values()
        values, row = self._values, self._values.written
        self._totals = values.sums[row]
        images = self.images
        self._compare(images.width, images.height, images.on_device(rgba), self._partial, self._totals)
        values.written += 1
        return LossValues(partial(values.row, row))

    def send(self) -> None:
        self._values.send()

    def backward(self, ssim_weight: float, scale: float = 1.0) -> None:
        by_l1, by_ssim = scale * (1.0 - ssim_weight), -scale * ssim_weight
        self._differentiate(self.images.width, self.images.height, float(by_l1), float(by_ssim), self._totals)

    @ti.func
    def _at(self, buffer: ti.template(), start, x, y, width, height):
        """Value of a plane at a pixel; 0 outside the image."""
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        value = 0.0
        if inside:
            value = buffer[start + (y + PAD) * self.images.stride + x + PAD]
        return value

    @ti.func
    def _replace_masked(self, p):
        """Replace the colour of a pixel by the reference as far as the pixel is masked."""
        plane = ti.static(self.images.plane)
        if self.images.valid[p] < 1.0:
            for c in ti.static(range(3)):
                r = self.images.reference[c * plane + p]
                d = self.images.colour[c * plane + p] - r
                self.images.colour[c * plane + p] = r + d * self.images.valid[p]

    @ti.func
    def _row_moments(self, at, a: ti.template(), b: ti.template(), band: ti.template()):
        """Write the moments of a horizontal window to `band`: the means of a and b, of a^2 + b^2, and of a b."""
        source = (at >> ROW_BITS) * SIDE + (at & (TILE_WIDTH - 1))
        mu_x, mu_y, squares, xy = 0.0, 0.0, 0.0, 0.0
        for q in ti.static(range(2 * RADIUS + 1)):
            va, vb = a[source + q], b[source + q]
            wa, wb = self.weights[q] * va, self.weights[q] * vb
            mu_x, mu_y = mu_x + wa, mu_y + wb
            squares, xy = squares + (wa * va + wb * vb), xy + wa * vb
        band[at] = mu_x
        band[BAND + at] = mu_y
        band[2 * BAND + at] = squares
        band[3 * BAND + at] = xy

    @ti.func
    def _window_moments(self, thread, band: ti.template()):
        """Moments of a pixel's window, from those of its rows."""
        mu_x, mu_y, squares, xy = 0.0, 0.0, 0.0, 0.0
        for q in ti.static(range(2 * RADIUS + 1)):
            at = thread + q * TILE_WIDTH
            mu_x += self.weights[q] * band[at]
            mu_y += self.weights[q] * band[BAND + at]
            squares += self.weights[q] * band[2 * BAND + at]
            xy += self.weights[q] * band[3 * BAND + at]
        return mu_x, mu_y, squares, xy

    @ti.func
    def _write_ssim(self, start, p, mu_x, mu_y, squares, xy):
        """Write the SSIM of a pixel and its derivatives with respect to the moments. Returns the SSIM."""
        plane = ti.static(self.images.plane)
        mean_square = mu_x * mu_x + mu_y * mu_y
        variances, covariance = squares - mean_square, xy - mu_x * mu_y
        # S = (A1 A2) / (B1 B2)
        A1, B1 = 2.0 * mu_x * mu_y + C1, mean_square + C1
        A2, B2 = 2.0 * covariance + C2, variances + C2
        inv = 1.0 / (B1 * B2)
        S = A1 * A2 * inv
        valid = self.images.valid[p]
        d_mu = 2.0 * inv * (mu_y * (A2 - A1) - mu_x * S * (B2 - B1))
        self.images.ssim_partial[3 * start + p] = d_mu * valid
        self.images.ssim_partial[3 * start + plane + p] = -S * B1 * inv * valid
        self.images.ssim_partial[3 * start + 2 * plane + p] = 2.0 * A1 * inv * valid
        self.images.ssim[start + p] = S
        return S

    @ti.kernel
    def _compare_tiles(
        self,
        width: ti.i32,
        height: ti.i32,
        image: ti.types.ndarray(dtype=ti.u8, ndim=3),
        partial: NUMBERS,
        totals: NUMBERS,
    ):
        plane = ti.static(self.images.plane)
        tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
        tiles = tiles_x * ((height + TILE_HEIGHT - 1) // TILE_HEIGHT)
        units, threads = 3 * tiles, 3 * tiles * THREADS
        for i in range(width * height):
            self.images.take_pixel(i % width, i // width, image)
            self._replace_masked((i // width + PAD) * self.images.stride + i % width + PAD)

        ti.loop_config(block_dim=THREADS)
        for i in range(threads):
            a = ti.simt.block.SharedArray((HALO,), ti.f32)
            b = ti.simt.block.SharedArray((HALO,), ti.f32)
            # First the four moments after the horizontal window, then the four sums.
            band = ti.simt.block.SharedArray((4 * BAND,), ti.f32)
            unit, thread = i >> THREAD_BITS, i & (THREADS - 1)
            channel, tile = unit // tiles, unit % tiles
            start = channel * plane
            left, top = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
            # Threads of the block may still use shared memory for the previous tile.
            ti.simt.block.sync()
            for k in range((HALO - thread + THREADS - 1) >> THREAD_BITS):
                at = thread + k * THREADS
                x, y = left - RADIUS + at % SIDE, top - RADIUS + at // SIDE
                a[at] = self._at(self.images.colour, start, x, y, width, height)
                b[at] = self._at(self.images.reference, start, x, y, width, height)
            ti.simt.block.sync()
            for k in range((BAND - thread + THREADS - 1) >> THREAD_BITS):
                self._row_moments(thread + k * THREADS, a, b, band)
            ti.simt.block.sync()
            mu_x, mu_y, squares, xy = self._window_moments(thread, band)
            l1, ssim, square, valid = 0.0, 0.0, 0.0, 0.0
            x, y = left + (thread & (TILE_WIDTH - 1)), top + (thread >> ROW_BITS)
            if x < width and y < height:
                p = (y + PAD) * self.images.stride + x + PAD
                valid = self.images.valid[p]
                ssim = self._write_ssim(start, p, mu_x, mu_y, squares, xy) * valid
                centre = ((thread >> ROW_BITS) + RADIUS) * SIDE + (thread & (TILE_WIDTH - 1)) + RADIUS
                d = a[centre] - b[centre]
                l1, square = ti.abs(d), d * d
            ti.simt.block.sync()
            band[thread] = l1
            band[THREADS + thread] = ssim
            band[2 * THREADS + thread] = square
            band[3 * THREADS + thread] = valid
            sum_over_block(band, thread, 4)
            if thread < 4:
                partial[unit * 4 + thread] = band[thread * THREADS]
        sum_blocks(units, partial, totals, 4)

    @ti.kernel
    def _differentiate_tiles(
        self, width: ti.i32, height: ti.i32, l1_scale: ti.f32, ssim_scale: ti.f32, totals: NUMBERS
    ):
        plane = ti.static(self.images.plane)
        tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
        tiles = tiles_x * ((height + TILE_HEIGHT - 1) // TILE_HEIGHT)
        ti.loop_config(block_dim=THREADS)
        for i in range(3 * tiles * THREADS):
            halo = ti.simt.block.SharedArray((3 * HALO,), ti.f32)
            band = ti.simt.block.SharedArray((3 * BAND,), ti.f32)
            unit, thread = i >> THREAD_BITS, i & (THREADS - 1)
            channel, tile = unit // tiles, unit % tiles
            start = channel * plane
            left, top = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
            ti.simt.block.sync()
            for k in range((HALO - thread + THREADS - 1) >> THREAD_BITS):
                at = thread + k * THREADS
                x, y = left - RADIUS + at % SIDE, top - RADIUS + at // SIDE
                for q in ti.static(range(3)):
                    source = 3 * start + q * plane
                    halo[q * HALO + at] = self._at(self.images.ssim_partial, source, x, y, width, height)
            ti.simt.block.sync()
            for k in range((BAND - thread + THREADS - 1) >> THREAD_BITS):
                at = thread + k * THREADS
                source = (at >> ROW_BITS) * SIDE + (at & (TILE_WIDTH - 1))
                for q in ti.static(range(3)):
                    total = 0.0
                    for j in ti.static(range(2 * RADIUS + 1)):
                        total += self.weights[j] * halo[q * HALO + source + j]
                    band[q * BAND + at] = total
            ti.simt.block.sync()
            smooth = ti.Vector.zero(ti.f32, 3)
            for q in ti.static(range(3)):
                for j in ti.static(range(2 * RADIUS + 1)):
                    smooth[q] += self.weights[j] * band[q * BAND + thread + j * TILE_WIDTH]
            x, y = left + (thread & (TILE_WIDTH - 1)), top + (thread >> ROW_BITS)
            if x < width and y < height:
                p = (y + PAD) * self.images.stride + x + PAD
                per_pixel = 1.0 / ti.max(totals[3], 1.0)
                a, b = self.images.colour[start + p], self.images.reference[start + p]
                sign = ti.select(a > b, 1.0, ti.select(a < b, -1.0, 0.0))
                by_ssim = smooth[0] + 2.0 * a * smooth[1] + b * smooth[2]
                gradient = per_pixel * (l1_scale * sign + ssim_scale * by_ssim)
                self.images.colour_grad[start + p] = gradient * self.images.valid[p]
