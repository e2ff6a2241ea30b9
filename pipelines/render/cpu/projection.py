"""Projection: visibility, depth order, image-space ellipses and colours of the Gaussians of a view.

EWA splatting [Zwicker 2001] with the opacity compensation of Mip-Splatting [Yu 2024]. The gradients, including that of
the camera tangent, come from Taichi's automatic differentiation; those of the harmonics, in which colours are linear,
are written out.

The differentiable loop goes over all Gaussians and skips those without a slot. Taichi then knows that no two iterations
have the same Gaussian, and adds to its gradients without atomics, with which the gradients took a quarter longer.
"""
# pyright: reportArgumentType=false, reportIndexIssue=false, reportInvalidTypeForm=false, reportOptionalSubscript=false

import numpy as np
import torch

from fields.buffers.view import ProjectedGaussians, ViewField
from fields.geometry.vec3 import cross, dot, rotate, rotate_back, rotation_from_quaternion
from fields.map.gaussians import SH_C0, GaussianField
from fields.runtime.compiled_kernel import HANDED_OUT, AsyncReadback, CompiledLoop
from fields.runtime.engine import ti
from pipelines.render.spherical_harmonics import add_sh_gradient, evaluate_sh

# Variance of the pixel's footprint, added to every ellipse [px^2].
BLUR = 0.3
# Contributions below this are not drawn, as in other splatting renderers.
ALPHA_MIN = 1.0 / 255.0
MIN_LOGIT = float(np.log(ALPHA_MIN / (1.0 - ALPHA_MIN)))
# Distance from the centre of an opaque Gaussian at which its contribution falls to ALPHA_MIN [standard deviations].
MAX_REACH = float(np.sqrt(-2.0 * np.log(ALPHA_MIN)))
# Lower bound of the compensation's determinant ratio. Below it, a Gaussian is far thinner than a pixel, and the
# gradient would be infinite.
MIN_DETERMINANT_RATIO = 1e-6
# Time of a Gaussian on one thread, for harmonics of degree 0 to 3 [ns].
PROJECT, PROJECT_BACK, BEGIN_BACK = (43, 48, 57, 67), (100, 107, 121, 136), (7, 12, 20, 33)
CHUNK = 512
# Two of these chunks per scheduling chunk, see `fields.runtime.compiled_kernel`.
SPREAD = HANDED_OUT // 2


@ti.data_oriented
class Projection:
    """Culls, sorts and projects `gaussians` into `projected`, for the view in `view`."""

    def __init__(self, gaussians: GaussianField, view: ViewField, projected: ProjectedGaussians) -> None:
        self.gaussians = gaussians
        self.view = view
        self.projected = projected
        self.tangent = gaussians.tangent
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
        """Fill `projected` for the current view.

        Returns:
            Number of visible Gaussians.
        """
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
        """Propagate the gradients in `projected` to the Gaussians and to their camera tangents."""
        count = self.projected.count
        if count:
            self._begin_back(count, self._all)
            self._project_back(count, self._all)

    def camera_gradient(self) -> np.ndarray:
        """Return d loss / d xi (6,) of the view's T_camera_world, summed in a fixed order."""
        count = self.projected.count
        chunks = -(-count // CHUNK)
        partial = np.zeros((chunks, 6), dtype=np.float64)
        if count:
            self._sum_tangents(count, count, partial)
        return partial.sum(axis=0)

    def async_camera_gradient(self) -> AsyncReadback:
        """Return `camera_gradient` with the interface of the GPU. On the CPU, there is nothing to wait for."""
        return AsyncReadback(torch.from_numpy(self.camera_gradient()))

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

    @ti.func
    def _camera(self):
        """The view's T_camera_world (3, 4), and an upper bound on the stretch of its linearised projection."""
        rotation, translation = self.view.rotation[None], self.view.translation[None]
        focal, limits = self.view.focal[None], self.view.limits[None]
        camera = ti.Matrix.zero(self.projected.real, 3, 4)
        for r in ti.static(range(3)):
            for c in ti.static(range(3)):
                camera[r, c] = rotation[r, c]
            camera[r, 3] = translation[r]
        # |rows of J| <= f / z * sqrt(1 + limit^2).
        bound = ti.max(ti.max(-limits[0], limits[1]), ti.max(-limits[2], limits[3]))
        return camera, ti.max(focal[0], focal[1]) * ti.sqrt(1.0 + bound * bound)

    @ti.func
    def _seen_at(self, i, camera, stretch):
        """Depth (float32) of Gaussian i if the view may see it, else 0. camera, stretch: from `_camera`."""
        focal, centre, size = self.view.focal[None], self.view.centre[None], self.view.size[None]
        position = self.gaussians.position[i]
        p = camera @ ti.Vector([position[0], position[1], position[2], ti.cast(1.0, self.projected.real)])
        visible = 0
        if p.z > self.view.near[None] and self.gaussians.opacity_logit[i] > MIN_LOGIT:
            inv_z = 1.0 / p.z
            sigma = ti.exp(self.gaussians.log_scale[i].max()) * stretch * inv_z
            # The reach of an opaque Gaussian: the exact one would cost an exponential and a logarithm more.
            radius = MAX_REACH * ti.sqrt(sigma * sigma + BLUR)
            x = focal[0] * p.x * inv_z + centre[0]
            y = focal[1] * p.y * inv_z + centre[1]
            if x + radius > 0.0 and x - radius < size[0] and y + radius > 0.0 and y - radius < size[1]:
                visible = 1
        return ti.select(visible == 1, ti.cast(p.z, ti.f32), 0.0)

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

    @ti.func
    def _project_one(self, i, s, t):
        """Project Gaussian i to slot s, with the camera tangent t."""
        xi = self.tangent[t]
        rho, omega = ti.Vector([xi[0], xi[1], xi[2]]), ti.Vector([xi[3], xi[4], xi[5]])
        W = self.view.rotation[None]
        focal, limits = self.view.focal[None], self.view.limits[None]

        # exp(xi) to first order, whose value and derivative are exact at xi = 0.
        tracked = rotate(W, self.gaussians.position[i]) + self.view.translation[None]
        p = tracked + cross(omega, tracked) + rho
        inv_z = 1.0 / p[2]
        tx, ty = p[0] * inv_z, p[1] * inv_z
        # Rows of the Jacobian of the pixel position, linearised inside the frustum's margin.
        jx = -ti.min(ti.max(tx, limits[0]), limits[1])
        jy = -ti.min(ti.max(ty, limits[2]), limits[3])
        row_x = ti.Vector([1.0, 0.0, jx]) * (focal[0] * inv_z)
        row_y = ti.Vector([0.0, 1.0, jy]) * (focal[1] * inv_z)
        # u, v: rows of J exp(omega) W R S, since row . (a + omega x a) = (row + row x omega) . a
        R = rotation_from_quaternion(self.gaussians.quaternion[i])
        scale = ti.exp(self.gaussians.log_scale[i])
        u = rotate_back(R, rotate_back(W, row_x + cross(row_x, omega))) * scale
        v = rotate_back(R, rotate_back(W, row_y + cross(row_y, omega))) * scale

        sharp_xx, sharp_xy, sharp_yy = dot(u, u), dot(u, v), dot(v, v)
        minors = cross(u, v)
        # Cauchy-Binet avoids the cancellation of xx * yy - xy^2, which would leave only rounding for needles.
        sharp_determinant = dot(minors, minors)
        determinant = sharp_determinant + BLUR * (sharp_xx + sharp_yy) + BLUR * BLUR
        compensation = ti.sqrt(ti.max(sharp_determinant / determinant, MIN_DETERMINANT_RATIO))

        self.projected.mean[s] = ti.Vector([focal[0] * tx, focal[1] * ty]) + self.view.centre[None]
        self.projected.conic[s] = ti.Vector([sharp_yy + BLUR, -sharp_xy, sharp_xx + BLUR]) / determinant
        self.projected.depth[s] = p[2]
        self.projected.opacity[s] = compensation / (1.0 + ti.exp(-self.gaussians.opacity_logit[i]))

    @ti.func
    def _shade_one(self, i, s, t):
        """Compute the colour of Gaussian i in slot s, with the camera tangent t."""
        if ti.static(self.gaussians.sh_degree == 0):
            self.projected.colour[s] = ti.max(0.5 + SH_C0 * self.gaussians.sh[i, 0], 0.0)
        else:
            colour = evaluate_sh(ti.static(self.gaussians.sh_degree), self.gaussians.sh, i, self._direction(i, t))
            self.projected.colour[s] = ti.max(0.5 + colour, 0.0)

    @ti.func
    def _direction(self, i, t):
        """Unit vector (3) from the camera to Gaussian i in the world frame, with the camera tangent t."""
        xi = self.tangent[t]
        # Rotating a camera does not move its centre, so only rho changes the direction: W'(p + rho).
        tracked = rotate(self.view.rotation[None], self.gaussians.position[i]) + self.view.translation[None]
        ray = rotate_back(self.view.rotation[None], tracked + ti.Vector([xi[0], xi[1], xi[2]]))
        return ray / ti.sqrt(dot(ray, ray))

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
