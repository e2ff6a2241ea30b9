"""Projection: visibility, depth order, image-space ellipses and colours of the Gaussians of a view.

EWA splatting [Zwicker 2001] with the opacity compensation of Mip-Splatting [Yu 2024]. The gradients, including that of
the camera tangent, come from Taichi's automatic differentiation; those of the harmonics, in which colours are linear,
are written out.

The differentiable loop goes over all Gaussians and skips those without a slot. Taichi then knows that no two iterations
have the same Gaussian, and adds to its gradients without atomics, with which the gradients took a quarter longer.
"""
# pyright: reportArgumentType=false, reportIndexIssue=false, reportInvalidTypeForm=false, reportOptionalSubscript=false

import numpy as np

from fields.buffers.view import ProjectedGaussians, ViewField
from fields.map.gaussians import GaussianField
from fields.runtime.compiled_kernel import HANDED_OUT, CompiledLoop
from fields.runtime.engine import ti
from pipelines.render.formulas import ProjectionFormulas
from pipelines.render.spherical_harmonics import add_sh_gradient

# Time of a Gaussian on one thread, for harmonics of degree 0 to 3 [ns].
PROJECT, PROJECT_BACK, BEGIN_BACK = (43, 48, 57, 67), (100, 107, 121, 136), (7, 12, 20, 33)
CHUNK = 512
# Two of these chunks per scheduling chunk, see `fields.runtime.compiled_kernel`.
SPREAD = HANDED_OUT // 2


@ti.data_oriented
class Projection(ProjectionFormulas):
    """Culls, sorts and projects `gaussians` into `projected`, for the view in `view`."""

    def __init__(self, gaussians: GaussianField, view: ViewField, projected: ProjectedGaussians) -> None:
        super().__init__(gaussians, view, projected, gaussians.tangent)
        self._keys = np.zeros(1, dtype=np.uint64)
        self._depths = np.zeros(1, dtype=np.float32)
        self._chunk_counts = np.zeros(1, dtype=np.int32)
        self._all = 0  # Gaussians in the map that was projected
        self._cull, self._compact = CompiledLoop(self._cull_chunks, 35), CompiledLoop(self._compact_chunks, 10)
        self._set_order = CompiledLoop(self._set_sorted, 3)
        self._sum_tangents = CompiledLoop(self._sum_tangents_of_chunks, 8)
        degree = gaussians.sh_degree
        self._project = CompiledLoop(self.project, PROJECT[degree])
        self._project_back = CompiledLoop(self.project, PROJECT_BACK[degree], reverse=True)
        self._begin_back = CompiledLoop(self._begin_gradients, BEGIN_BACK[degree])

    def forward(self) -> int:
        self._all = n = self.gaussians.count
        self.projected.count = count = self._visible()
        if count:
            # Keys hold the depth in the upper bits and the slot in the lower. They are unique, so the result does not
            # depend on the stability of the sort.
            self._keys[:count].sort()
            self._set_order(count, count, self._keys)
            self._project(count, n)
        else:
            self.projected.seen[None] = 0
        return count

    def backward(self) -> None:
        count = self.projected.count
        if count:
            self._begin_back(count, self._all)
            self._project_back(count, self._all)

    def camera_gradient(self) -> np.ndarray:
        count = self.projected.count
        chunks = -(-count // CHUNK)
        partial = np.zeros((chunks, 6), dtype=np.float64)
        if count:
            self._sum_tangents(count, count, partial)
        return partial.sum(axis=0)

    # ---- which, and in which order ---------------------------------------------------------------------------

    def _visible(self) -> int:
        """Assign a slot and a sort key to every Gaussian that the view may see; return their number."""
        n = self.gaussians.count
        if n == 0:
            return 0
        if len(self._depths) < n:
            size = 1 << (n - 1).bit_length()
            self._depths = np.zeros(size, dtype=np.float32)
            self._keys = np.zeros(size, dtype=np.uint64)
            self._chunk_counts = np.zeros(-(-size // CHUNK), dtype=np.int32)
        chunks = -(-n // CHUNK)
        self._cull(n, n, self._depths, self._chunk_counts)
        ends = np.cumsum(self._chunk_counts[:chunks])
        self._chunk_counts[1:chunks] = ends[:-1]
        self._chunk_counts[0] = 0
        self._compact(n, n, self._depths, self._chunk_counts, self._keys)
        return int(ends[-1])

    @ti.kernel
    def _cull_chunks(self, alone: ti.template(), n: ti.i32, depths: ti.types.ndarray(), counts: ti.types.ndarray()):
        ti.loop_config(serialize=alone)
        for i in range(((n + CHUNK - 1) // CHUNK) * SPREAD):
            if i % SPREAD == 0:
                self._cull_chunk(i // SPREAD, n, depths, counts)

    @ti.func
    def _cull_chunk(self, chunk, n, depths: ti.template(), counts: ti.template()):
        camera, stretch = self._camera()
        seen = 0
        for i in range(chunk * CHUNK, ti.min(n, (chunk + 1) * CHUNK)):
            depth = self._seen_at(i, camera, stretch)
            depths[i] = depth
            seen += ti.cast(depth > 0.0, ti.i32)
        counts[chunk] = seen

    @ti.kernel
    def _compact_chunks(
        self,
        alone: ti.template(),
        n: ti.i32,
        depths: ti.types.ndarray(),
        first: ti.types.ndarray(),
        keys: ti.types.ndarray(),
    ):
        ti.loop_config(serialize=alone)
        for i in range(((n + CHUNK - 1) // CHUNK) * SPREAD):
            if i % SPREAD == 0:
                self._compact_chunk(i // SPREAD, n, depths, first, keys)

    @ti.func
    def _compact_chunk(self, chunk, n, depths: ti.template(), first: ti.template(), keys: ti.template()):
        slot = first[chunk]
        for i in range(chunk * CHUNK, ti.min(n, (chunk + 1) * CHUNK)):
            if depths[i] > 0.0:
                # The bits of positive floats order like the values.
                bits = ti.cast(ti.bit_cast(depths[i], ti.u32), ti.u64)
                keys[slot] = (bits << 32) | ti.cast(slot, ti.u64)
                self.projected.gaussian[slot] = i
                self.gaussians.slot[i] = slot
                self.tangent[i].fill(0.0)
                slot += 1
            else:
                self.gaussians.slot[i] = -1

    @ti.kernel
    def _set_sorted(self, alone: ti.template(), count: ti.i32, keys: ti.types.ndarray()):
        self.projected.seen[None] = count
        ti.loop_config(serialize=alone)
        for k in range(count):
            self.projected.order[k] = ti.cast(keys[k] & ti.u64(0xFFFFFFFF), ti.i32)

    # ---- the differentiable part -----------------------------------------------------------------------------

    @ti.kernel
    def project(self, alone: ti.template(), n: ti.i32):
        """Compute ellipse, depth, compensated opacity and colour of every slot."""
        ti.loop_config(serialize=alone)
        for i in range(n):
            ti.stop_grad(self.gaussians.sh)  # `_begin_gradients` adds it: Taichi would use atomics
            s = self.gaussians.slot[i]
            if s >= 0:
                self._project_one(i, s, i)
                self._shade_one(i, s, i)

    @ti.kernel
    def _begin_gradients(self, alone: ti.template(), n: ti.i32):
        """Clear the gradients of the tangents, mark what is seen, and add the gradients of the harmonics."""
        ti.loop_config(serialize=alone)
        for i in range(n):
            s = self.gaussians.slot[i]
            if s >= 0:
                self.tangent.grad[i].fill(0.0)
                self.gaussians.touched[i] = 1
                colour, gradient = self.projected.colour[s], self.projected.colour.grad[s]
                for c in ti.static(range(3)):
                    gradient[c] = ti.select(colour[c] > 0.0, gradient[c], 0.0)
                degree = ti.static(self.gaussians.sh_degree)
                direction = self._direction(i, i)
                add_sh_gradient(degree, self.gaussians.sh.grad, i, direction, gradient)

    @ti.kernel
    def _sum_tangents_of_chunks(self, alone: ti.template(), count: ti.i32, partial: ti.types.ndarray()):
        ti.loop_config(serialize=alone)
        for i in range(((count + CHUNK - 1) // CHUNK) * SPREAD):
            if i % SPREAD == 0:
                self._sum_tangents_chunk(i // SPREAD, count, partial)

    @ti.func
    def _sum_tangents_chunk(self, chunk, count, partial: ti.template()):
        total = ti.Vector.zero(self.projected.real, 6)
        for s in range(chunk * CHUNK, ti.min(count, (chunk + 1) * CHUNK)):
            total += self.tangent.grad[self.projected.gaussian[s]]
        for c in ti.static(range(6)):
            partial[chunk, c] = total[c]
