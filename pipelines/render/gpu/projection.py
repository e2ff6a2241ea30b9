"""Projection on a GPU: depths are sorted on the device, and the number of visible Gaussians is known only there."""
# pyright: reportArgumentType=false, reportIndexIssue=false, reportInvalidTypeForm=false, reportOptionalSubscript=false

import numpy as np
import torch

from fields.buffers.view import ProjectedGaussians, ViewField
from fields.map.gaussians import GaussianField
from fields.runtime.backend import torch_device
from fields.runtime.compiled_kernel import AsyncReadback, CompiledKernel
from fields.runtime.engine import ti
from pipelines.render.formulas import ProjectionFormulas
from pipelines.render.gpu.reductions import THREAD_BITS, THREADS, sum_over_block

# Sorts after every depth. Not infinity, since Taichi's fast-math assumes that there is none.
UNSEEN = 3e38
# Number of blocks that sum the slots' tangents. The host adds their sums, which saves a launch.
BLOCKS = 64


@ti.data_oriented
class DeviceProjection(ProjectionFormulas):
    """Culls, sorts and projects `gaussians` into `projected`, with the formulas of the CPU.

    The differentiable loops go over slots, which come in the order of depth: a GPU adds to gradients with atomics that
    cost it little.
    """

    def __init__(self, gaussians: GaussianField, view: ViewField, projected: ProjectedGaussians) -> None:
        super().__init__(gaussians, view, projected, projected.tangent)
        self._depths = torch.empty(0, dtype=torch.float32, device=torch_device())
        self._cull, self._assign = CompiledKernel(self._cull_all), CompiledKernel(self._assign_sorted)
        self._sum_tangents = CompiledKernel(self._sum_all_tangents)
        self._project, self._project_back = (CompiledKernel(self._project_slots, reverse) for reverse in (False, True))
        self._shade, self._shade_back = (CompiledKernel(self._shade_slots, reverse) for reverse in (False, True))
        self._clear = CompiledKernel(self._clear_tangent_gradients)
        self._tangents = torch.zeros((BLOCKS, 6), dtype=torch.float32, device=torch_device())

    def forward(self) -> int:
        self.projected.count = n = self.gaussians.count
        if n == 0:
            self._none_seen()
            return 0
        if len(self._depths) < n:
            self._depths = torch.empty(1 << (n - 1).bit_length(), dtype=torch.float32, device=torch_device())
        depths = self._depths[:n]
        self._cull(depths)
        # A stable sort keeps Gaussians of equal depth in order.
        ordered, gaussian = torch.sort(depths, stable=True)
        self._assign(ordered, gaussian)
        self._project()
        self._shade()
        return n

    def backward(self) -> None:
        if self.projected.count:
            self._clear()
            self._shade_back()
            self._project_back()

    def camera_gradient(self) -> np.ndarray:
        return self.async_camera_gradient().numpy()

    def async_camera_gradient(self) -> AsyncReadback:
        self._sum_tangents(self._tangents)
        return AsyncReadback(self._tangents, summed=True)

    @ti.kernel
    def _none_seen(self):
        self.projected.seen[None] = 0

    @ti.kernel
    def _cull_all(self, depths: ti.types.ndarray(dtype=ti.f32, ndim=1)):
        for i in range(depths.shape[0]):
            camera, stretch = self._camera()
            depth = self._seen_at(i, camera, stretch)
            depths[i] = ti.select(depth > 0.0, depth, UNSEEN)

    @ti.kernel
    def _assign_sorted(
        self, depths: ti.types.ndarray(dtype=ti.f32, ndim=1), gaussian: ti.types.ndarray(dtype=ti.i64, ndim=1)
    ):
        n = depths.shape[0]
        for s in range(n):
            if depths[s] < UNSEEN:
                self.projected.gaussian[s] = ti.cast(gaussian[s], ti.i32)
                self.tangent[s].fill(0.0)
                if s + 1 == n or depths[ti.min(s + 1, n - 1)] >= UNSEEN:
                    self.projected.seen[None] = s + 1
            elif s == 0:
                self.projected.seen[None] = 0

    @ti.kernel
    def _project_slots(self):
        for s in range(self.projected.seen[None]):
            self._project_one(self.projected.gaussian[s], s, s)

    @ti.kernel
    def _shade_slots(self):
        for s in range(self.projected.seen[None]):
            self._shade_one(self.projected.gaussian[s], s, s)

    @ti.kernel
    def _clear_tangent_gradients(self):
        for s in range(self.projected.seen[None]):
            self.tangent.grad[s].fill(0.0)
            self.gaussians.touched[self.projected.gaussian[s]] = 1

    @ti.kernel
    def _sum_all_tangents(self, out: ti.types.ndarray(dtype=ti.f32, ndim=2)):
        ti.loop_config(block_dim=THREADS)
        for first in range(BLOCKS * THREADS):
            thread = first & (THREADS - 1)
            partial = ti.simt.block.SharedArray((6 * THREADS,), ti.f32)
            total = ti.Vector.zero(ti.f32, 6)
            for k in range((self.projected.seen[None] - first + BLOCKS * THREADS - 1) // (BLOCKS * THREADS)):
                total += self.tangent.grad[first + k * BLOCKS * THREADS]
            for c in ti.static(range(6)):
                partial[c * THREADS + thread] = total[c]
            sum_over_block(partial, thread, 6)
            if thread < 6:
                out[first >> THREAD_BITS, thread] = partial[thread * THREADS]
