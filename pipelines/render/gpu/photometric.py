"""The photometric model on a GPU: one thread per pixel. The gradient of the exposure is summed on the device."""
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false

import numpy as np
import torch

from fields.buffers.images import PAD, ImageBuffers
from fields.runtime.backend import torch_device, without_waiting
from fields.runtime.compiled_kernel import CompiledKernel
from fields.runtime.engine import ti
from pipelines.render.formulas import PhotometricBuffers
from pipelines.render.gpu.reductions import THREAD_BITS, THREADS, partial_sums, sum_blocks, sum_over_block

NUMBERS = ti.types.ndarray(dtype=ti.f32, ndim=1)


@ti.data_oriented
class DevicePhotometric(PhotometricBuffers):
    """Applies exposure and vignette to `images.colour` in place, and propagates gradients; see `Photometric`.

    Attributes:
        gradient: d loss / d exposure (12,) of the last image.
    """

    def __init__(self, images: ImageBuffers) -> None:
        super().__init__(images)
        self._partial = partial_sums(-(-images.max_width * images.max_height // THREADS), 12)
        self._forward_pixels, self._backward_pixels = (
            CompiledKernel(self._develop_pixels),
            CompiledKernel(self._undevelop_pixels),
        )
        self.gradient = torch.zeros(12, dtype=torch.float32, device=torch_device())

    def exposure_gradient(self) -> np.ndarray:
        return self.gradient.cpu().numpy().reshape(3, 4).astype(np.float64)

    def _develop(self) -> None:
        exposure = self._exposure
        if isinstance(exposure, np.ndarray):
            exposure = without_waiting(exposure.astype(np.float32).ravel())
        self._numbers = exposure
        self._forward_pixels(self.images.width, self.images.height, self._numbers)

    def _undevelop(self) -> None:
        self._backward_pixels(self.images.width, self.images.height, self._numbers, self._partial, self.gradient)

    @ti.kernel
    def _develop_pixels(self, width: ti.i32, height: ti.i32, exposure: NUMBERS):
        for i in range(width * height):
            plane = ti.static(self.images.plane)
            p = (i // width + PAD) * self.images.stride + i % width + PAD
            red, green, blue = self.images.colour[p], self.images.colour[plane + p], self.images.colour[2 * plane + p]
            self.rendered[p], self.rendered[plane + p], self.rendered[2 * plane + p] = red, green, blue
            for c in ti.static(range(3)):
                developed = exposure[4 * c] * red + exposure[4 * c + 1] * green + exposure[4 * c + 2] * blue
                developed += exposure[4 * c + 3]
                self.images.colour[c * plane + p] = developed * self.vignette[c * plane + p]

    @ti.kernel
    def _undevelop_pixels(self, width: ti.i32, height: ti.i32, exposure: NUMBERS, partial: NUMBERS, gradient: NUMBERS):
        blocks = (width * height + THREADS - 1) // THREADS
        ti.loop_config(block_dim=THREADS)
        for i in range(blocks * THREADS):
            store = ti.simt.block.SharedArray((12 * THREADS,), ti.f32)
            plane = ti.static(self.images.plane)
            thread = i & (THREADS - 1)
            # Sums of the block's previous pixels may not all have been read yet.
            ti.simt.block.sync()
            for c in ti.static(range(12)):
                store[c * THREADS + thread] = 0.0
            if i < width * height:
                p = (i // width + PAD) * self.images.stride + i % width + PAD
                rendered, h = ti.Vector.zero(ti.f32, 3), ti.Vector.zero(ti.f32, 3)
                for c in ti.static(range(3)):
                    rendered[c] = self.rendered[c * plane + p]
                    h[c] = self.images.colour_grad[c * plane + p] * self.vignette[c * plane + p]
                for c in ti.static(range(3)):
                    for j in ti.static(range(3)):
                        store[(4 * c + j) * THREADS + thread] = h[c] * rendered[j]
                    store[(4 * c + 3) * THREADS + thread] = h[c]
                    back = exposure[c] * h[0] + exposure[4 + c] * h[1] + exposure[8 + c] * h[2]
                    self.images.colour_grad[c * plane + p] = back
                    self.images.colour[c * plane + p] = rendered[c]
            sum_over_block(store, thread, 12)
            if thread < 12:
                partial[(i >> THREAD_BITS) * 12 + thread] = store[thread * THREADS]
        sum_blocks(blocks, partial, gradient, 12)
