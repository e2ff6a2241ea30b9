"""Projection on a GPU: depths are sorted on the device, and the number of visible Gaussians is known only there."""
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportInvalidTypeForm=false, reportOptionalSubscript=false

import numpy as np
import torch

from fields.buffers.view import ProjectedGaussians, ViewField
from fields.map.gaussians import GaussianField
from fields.runtime.backend import torch_device
from fields.runtime.compiled_kernel import CompiledKernel
from fields.runtime.engine import ti
from pipelines.render.formulas import ProjectionFormulas
from pipelines.render.gpu.binning import DeviceBinning
from pipelines.render.gpu.reductions import THREAD_BITS, THREADS, sum_over_block

# Sorts after every depth. Not infinity, since Taichi's fast-math assumes that there is none.
UNSEEN = 3e38
# Number of blocks that sum the slots' tangents. The host adds their sums, which saves a launch.
BLOCKS = 64

NUMBERS = ti.types.ndarray(dtype=ti.f32, ndim=1)


@ti.data_oriented
class DeviceProjection(ProjectionFormulas):
    """Culls, sorts and projects `gaussians` into `projected`, with the formulas of the CPU.

    Slots come in the order of depth: a GPU adds to gradients with atomics that cost it little.

    Attributes:
        tangents: Sums of the tangents' gradients by block (BLOCKS, 6).
    """

    def __init__(
        self, gaussians: GaussianField, view: ViewField, projected: ProjectedGaussians, binning: DeviceBinning
    ) -> None:
        super().__init__(gaussians, view, projected, projected.tangent)
        self.binning = binning
        self._depths = torch.empty(0, dtype=torch.float32, device=torch_device())
        self._cull, self._project = CompiledKernel(self._cull_all), CompiledKernel(self._project_all)
        self._propagate = CompiledKernel(self._differentiable, reverse=True)
        self._sum_tangents = CompiledKernel(self._sum_all_tangents)
        self.tangents = torch.zeros((BLOCKS, 6), dtype=torch.float32, device=torch_device())

    def forward(self) -> int:
        self.projected.count = count = self.gaussians.count
        n = max(count, 1)  # an array of zero elements has no address
        if len(self._depths) < n:
            self._depths = torch.empty(1 << (n - 1).bit_length(), dtype=torch.float32, device=torch_device())
        depths = self._depths[:n]
        self._cull(count, self.view.pose, self.view.lens, self.view.width, self.view.height, depths)
        # A stable sort keeps Gaussians of equal depth in order.
        ordered, gaussian = torch.sort(depths, stable=True)
        self._project(*self.binning.tiles(), ordered, gaussian, self.binning.make_counts(n))
        return count

    def backward(self) -> None:
        self._propagate()

    def camera_gradient(self) -> np.ndarray:
        self._sum_tangents(self.tangents)
        return self.tangents.cpu().numpy().sum(axis=0, dtype=np.float64)

    @ti.kernel
    def _cull_all(self, count: ti.i32, pose: NUMBERS, lens: NUMBERS, width: ti.i32, height: ti.i32, depths: NUMBERS):
        self.view.write(pose, lens, width, height)
        self.projected.seen[None] = 0
        for i in range(depths.shape[0]):
            depth = 0.0
            if i < count:
                camera, stretch = self._camera()
                depth = self._seen_at(i, camera, stretch)
            depths[i] = ti.select(depth > 0.0, depth, UNSEEN)

    @ti.kernel
    def _project_all(
        self,
        tiles_x: ti.i32,
        tiles_y: ti.i32,
        depths: NUMBERS,
        gaussian: ti.types.ndarray(dtype=ti.i64, ndim=1),
        counts: ti.types.ndarray(dtype=ti.i32, ndim=1),
    ):
        """Fill the slots, and count the tiles that each of them reaches."""
        n = depths.shape[0]
        for s in range(n):
            tiles = 0
            if depths[s] < UNSEEN:
                i = ti.cast(gaussian[s], ti.i32)
                self.projected.gaussian[s] = i
                self.tangent[s].fill(0.0)
                self._project_one(i, s, s)
                self._shade_one(i, s, s)
                tiles = self.binning.count_tiles(s, tiles_x, tiles_y)
                if s + 1 == n or depths[ti.min(s + 1, n - 1)] >= UNSEEN:
                    self.projected.seen[None] = s + 1
            counts[s] = tiles

    @ti.kernel
    def _differentiable(self):
        """What `_project_all` does, in a form whose reverse compiles quickly."""
        for s in range(self.projected.seen[None]):
            self._project_one(self.projected.gaussian[s], s, s)
        for s in range(self.projected.seen[None]):
            self._shade_one(self.projected.gaussian[s], s, s)

    @ti.kernel
    def _sum_all_tangents(self, out: ti.types.ndarray(dtype=ti.f32, ndim=2)):
        self.sum_tangents(out)

    @ti.func
    def sum_tangents(self, out: ti.template()):
        """Sum the gradients of the tangents by BLOCKS blocks, in a loop of a kernel, to (BLOCKS, 6)."""
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
