"""`GaussianField`: the Gaussians of a map, in a pool that grows without recompiling kernels."""
# pyright: reportArgumentType=false, reportCallIssue=false, reportInvalidTypeForm=false, reportOptionalSubscript=false

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from fields.map.gaussian_arrays import read_numbers, read_values, write_integers, write_reals, write_values
from fields.runtime.backend import growing, on_gpu, place, refuse_too_many_fields
from fields.runtime.engine import ti
from fields.runtime.tenancy import in_engine, settled

# The constant spherical harmonic: colour = 0.5 + SH_C0 * sh[0].
SH_C0 = 0.28209479177387814
BLOCK = 1024
NO_ANCHOR = -1
MOMENTS = ("_m", "_v")  # suffixes of the names of Adam's first and second moments


@in_engine("append", "remove", "load", "restore", "extend", "take", "gradients_into", "clear_gradients", "take_caught")
@in_engine("to_numpy", "anchors", "coverages", "gradients_to_numpy", "history")
@ti.data_oriented
class GaussianField:
    """Anisotropic Gaussians in the world frame, with their gradients and Adam moments.

    They are stored at indices 0 to `count - 1`, in a tree of pointer(blocks) over dense(1024), so that memory follows
    their number. On a GPU, the storage is dense and holds `max_gaussians` from the start.

    Args:
        sh_degree: Degree of the spherical harmonics of colour.
        max_gaussians: Size of the pool, rounded up to a multiple of 1024.
        real: Taichi type of the values, `ti.f32` or `ti.f64`.

    Attributes:
        position: Means (3).
        log_scale: Logarithms of the standard deviations (3).
        quaternion: Rotations (4) as (w, x, y, z), of any length but zero.
        opacity_logit: Logits of the opacities.
        sh: Coefficients (K, 3) of the harmonics, K = (sh_degree + 1)^2, in the layout of 3DGS files.
        steps: Number of Adam updates of each Gaussian.
        anchor: Number of the view that placed each Gaussian; NO_ANCHOR if it is not known.
        coverage: Largest coverage of each Gaussian in the views measured so far [px], see `Contribution`.
        slot, tangent: On the CPU, slot (-1: none) and copy of the camera tangent in a view, see `Projection`.
        count: Number of Gaussians.
        capacity: Size of the pool.

    Example:
        gaussians = modp_ti.GaussianField(sh_degree=1)
        gaussians.load(modp_ti.read_splats("out/room/splats.ply"))
    """

    def __init__(self, sh_degree: int = 0, max_gaussians: int = 1_500_000, real: object = ti.f32) -> None:
        self.sh_degree = sh_degree
        self.sh_count = (sh_degree + 1) ** 2
        self.real = real
        self.count = 0
        self.capacity = -(-max_gaussians // BLOCK) * BLOCK
        self.dtype = np.float64 if real == ti.f64 else np.float32

        def vector(n: int, needs_grad: bool = False):
            return ti.Vector.field(n, real, needs_grad=needs_grad)

        with settled(nodes=1) as self.tenancy:
            self.position, self.position_m, self.position_v = vector(3, True), vector(3), vector(3)
            self.log_scale, self.log_scale_m, self.log_scale_v = vector(3, True), vector(3), vector(3)
            self.quaternion, self.quaternion_m, self.quaternion_v = vector(4, True), vector(4), vector(4)
            self.opacity_logit = ti.field(real, needs_grad=True)
            self.opacity_logit_m, self.opacity_logit_v = ti.field(real), ti.field(real)
            self.sh, self.sh_m, self.sh_v = vector(3, True), vector(3), vector(3)
            self.steps = ti.field(ti.i32)
            self.anchor = ti.field(ti.i32)
            self.touched = ti.field(ti.i32)
            self.coverage = ti.field(ti.f32)
            self._caught = ti.field(ti.i32)

            builder = ti.FieldsBuilder()
            blocks = growing(builder, self.capacity // BLOCK)
            # One dense child per access pattern, so that culling does not load Adam's moments into the cache.
            geometry = (self.position, self.log_scale, self.quaternion, self.opacity_logit)
            place(geometry, blocks, BLOCK)
            place([f.grad for f in geometry], blocks, BLOCK)
            moments = [self.position_m, self.position_v, self.log_scale_m, self.log_scale_v]
            moments += [self.quaternion_m, self.quaternion_v, self.opacity_logit_m, self.opacity_logit_v]
            place(moments, blocks, BLOCK)
            for fields in ([self.sh], [self.sh.grad], [self.sh_m, self.sh_v]):
                place(fields, blocks, BLOCK, self.sh_count)
            place([self.steps, self.anchor, self.touched, self.coverage], blocks, BLOCK)
            if not on_gpu():
                self.slot, self.tangent = ti.field(ti.i32), vector(6, True)
                place([self.slot, self.tangent, self.tangent.grad], blocks, BLOCK)
            builder.dense(ti.i, 2).place(self._caught)
            builder.finalize()
            refuse_too_many_fields(self._caught)

    def __len__(self) -> int:
        return self.count

    @property
    def bytes_each(self) -> int:
        """Bytes of one Gaussian: all fields, with gradients and moments."""
        numbers, integers = (0, 4) if on_gpu() else (12, 5)  # tangent and slot
        return (4 * (11 + 3 * self.sh_count) + numbers) * np.dtype(self.dtype).itemsize + 4 * integers

    # ---- growing and shrinking -------------------------------------------------------------------------------

    def append(
        self,
        position: NDArray,
        log_scale: NDArray,
        quaternion: NDArray,
        opacity_logit: NDArray,
        sh: NDArray,
        *,
        anchor: int = NO_ANCHOR,
    ) -> None:
        """Add N Gaussians with zero gradients, moments and step counts.

        Args:
            position: Means (N, 3) in the world frame.
            log_scale: Logarithms of the standard deviations (N, 3).
            quaternion: Rotations (N, 4) as (w, x, y, z).
            opacity_logit: Logits (N,) of the opacities.
            sh: Coefficients (N, K, 3) of the harmonics.
            anchor: Anchor of all new Gaussians.

        Raises:
            ValueError: If a value is not finite or a quaternion is zero (the message names the first such Gaussian), if
                the shapes disagree, or if the pool is full.
        """
        arrays = [
            np.ascontiguousarray(a, dtype=self.dtype) for a in (position, log_scale, quaternion, opacity_logit, sh)
        ]
        n = len(arrays[0])
        shapes = [(n, 3), (n, 3), (n, 4), (n,), (n, self.sh_count, 3)]
        for array, shape, name in zip(arrays, shapes, _NAMES, strict=True):
            if array.shape != shape:
                raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
            bad = ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
            if bad.any():
                raise ValueError(f"Gaussian {int(np.argmax(bad))}: {name} is not finite")
        zero = np.linalg.norm(arrays[2], axis=1) < 1e-12
        if zero.any():
            raise ValueError(f"Gaussian {int(np.argmax(zero))}: quaternion is zero")
        if self.count + n > self.capacity:
            raise ValueError(f"{self.count + n} Gaussians exceed the pool of {self.capacity}; raise max_gaussians")
        if n:
            self._write(self.count, anchor, *arrays)
            self.count += n

    def remove(self, keep: NDArray[np.bool_]) -> int:
        """Remove the Gaussians where `keep` (count,) is false, and return their number.

        Kept Gaussians from the end fill the holes in order, which is parallel and deterministic.
        """
        if keep.shape != (self.count,):
            raise ValueError(f"keep has shape {keep.shape}, expected ({self.count},)")
        kept = int(np.count_nonzero(keep))
        removed = self.count - kept
        holes = np.flatnonzero(~keep[:kept]).astype(np.int32)
        if len(holes):
            self._move((kept + np.flatnonzero(keep[kept:])).astype(np.int32), holes)
        self.count = kept
        return removed

    # ---- saving and loading ----------------------------------------------------------------------------------

    def to_numpy(self, first: int = 0) -> dict[str, NDArray]:
        """Return the values of all Gaussians from `first` on, by name.

        Returns:
            position (N, 3), log_scale (N, 3), quaternion (N, 4), opacity_logit (N,) and sh (N, K, 3).
        """
        return self._to_numpy([getattr(self, name) for name in _NAMES], first)

    def anchors(self, first: int = 0) -> NDArray[np.int32]:
        """Return the anchor (N,) of every Gaussian from `first` on."""
        return self._numbers(self.anchor, first, np.int32)

    def coverages(self, first: int = 0) -> NDArray[np.float32]:
        """Return the coverage (N,) of every Gaussian from `first` on [px]."""
        return self._numbers(self.coverage, first, np.float32)

    def gradients_to_numpy(self) -> dict[str, NDArray]:
        """Return the gradients of all Gaussians, with the names and shapes of `to_numpy`."""
        return self._to_numpy([getattr(self, name).grad for name in _NAMES], 0)

    def _to_numpy(self, fields: list, first: int) -> dict[str, NDArray]:
        n, k = self.count - first, self.sh_count
        arrays = [np.zeros(s, dtype=self.dtype) for s in ((n, 3), (n, 3), (n, 4), (n,), (n, k, 3))]
        read_values(*fields, first, *arrays)
        return dict(zip(_NAMES, arrays, strict=True))

    def _numbers(self, field: ti.Field, first: int, dtype: type) -> NDArray:
        out = np.zeros(self.count - first, dtype=dtype)
        if len(out):
            read_numbers(field, first, out)
        return out

    def load(self, state: dict[str, NDArray]) -> None:
        """Replace all Gaussians by values in the form of `to_numpy`, optionally with their anchors (N,) as `anchor`.

        Raises:
            ValueError: As in `append`. The Gaussians are then unchanged.
        """
        before, self.count = self.count, 0
        try:
            anchor = state.get("anchor")
            if anchor is not None and np.shape(anchor) != np.shape(state["opacity_logit"]):
                raise ValueError(f"anchor has shape {np.shape(anchor)}, expected {np.shape(state['opacity_logit'])}")
            self.append(*(state[name] for name in _NAMES))
        except ValueError:
            self.count = before
            raise
        if anchor is not None and self.count:
            write_integers(self.anchor, 0, np.ascontiguousarray(anchor, dtype=np.int32))

    def history(self, first: int = 0) -> dict[str, NDArray]:
        """Return the optimiser state from `first` on: moments `NAME_m`, `NAME_v` of each value, `steps` and `anchor`.

        With `to_numpy`, this is the complete state of the Gaussians between two steps.
        """
        moments = {
            name + end: array
            for end in MOMENTS
            for name, array in self._to_numpy([getattr(self, name + end) for name in _NAMES], first).items()
        }
        return moments | {"steps": self._numbers(self.steps, first, np.int32), "anchor": self.anchors(first)}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Replace all Gaussians by saved values and optimiser state, see `extend`."""
        self.count = 0
        self.extend(state)

    def extend(self, state: dict[str, NDArray]) -> None:
        """Add saved Gaussians: the entries of `to_numpy` and `history`, and optionally the `coverage` (N,).

        Raises:
            KeyError: If an entry is missing.
            ValueError: As in `append`.
        """
        first = self.count
        self.append(*(state[name] for name in _NAMES))
        if self.count == first:
            return
        for end in MOMENTS:
            arrays = [np.ascontiguousarray(state[name + end], dtype=self.dtype) for name in _NAMES]
            write_values(*(getattr(self, name + end) for name in _NAMES), first, *arrays)
        for name in ("steps", "anchor"):
            write_integers(getattr(self, name), first, np.ascontiguousarray(state[name], dtype=np.int32))
        if "coverage" in state:
            write_reals(self.coverage, first, np.ascontiguousarray(state["coverage"], dtype=np.float32))

    def take(self, tensors: Sequence[torch.Tensor]) -> None:
        """Replace all Gaussians by tensors, without a copy through the host.

        The values are not checked; they must satisfy the conditions of `append`.

        Args:
            tensors: Values in the order and shapes of `append`, contiguous, of its type, on the kernels' device.

        Raises:
            ValueError: If the pool is too small.
        """
        count = len(tensors[0])
        if count > self.capacity:
            raise ValueError(f"{count} Gaussians exceed the pool of {self.capacity}")
        self.count = count
        if count:
            self._write(0, NO_ANCHOR, *tensors)

    def gradients_into(self, tensors: Sequence[torch.Tensor]) -> None:
        """Write the gradients of all Gaussians into tensors of the form that `take` expects."""
        if self.count:
            read_values(*(getattr(self, name).grad for name in _NAMES), 0, *tensors)

    def clear_gradients(self) -> None:
        """Set the gradients accumulated since the last Adam step to zero."""
        if self.count:
            self._clear_gradients(self.count)

    def take_caught(self) -> tuple[int, int]:
        """Return and reset the numbers of skipped steps and of exploded Gaussians, see `Adam`."""
        skipped, exploded = self._caught[0], self._caught[1]
        self._caught.fill(0)
        return skipped, exploded  # pyright: ignore[reportReturnType]  # Taichi annotates elements as vectors

    def opacities(self) -> NDArray:
        """Return the opacity (N,) in (0, 1) of all Gaussians."""
        return 1.0 / (1.0 + np.exp(-self.to_numpy()["opacity_logit"]))

    @ti.kernel
    def _clear_gradients(self, count: ti.i32):
        for i in range(count):
            if self.touched[i] != 0:
                self.touched[i] = 0
                self.forget_gradient(i)

    @ti.func
    def forget_gradient(self, i):
        """Set the gradients of one Gaussian to zero."""
        self.position.grad[i].fill(0.0)
        self.log_scale.grad[i].fill(0.0)
        self.quaternion.grad[i].fill(0.0)
        self.opacity_logit.grad[i] = 0.0
        for k in range(self.sh_count):
            self.sh.grad[i, k].fill(0.0)

    @ti.func
    def _forget(self, i):
        """Zero the gradients, moments and step count of one Gaussian."""
        self.forget_gradient(i)
        self.position_m[i].fill(0.0)
        self.position_v[i].fill(0.0)
        self.log_scale_m[i].fill(0.0)
        self.log_scale_v[i].fill(0.0)
        self.quaternion_m[i].fill(0.0)
        self.quaternion_v[i].fill(0.0)
        self.opacity_logit_m[i] = 0.0
        self.opacity_logit_v[i] = 0.0
        for k in range(self.sh_count):
            self.sh_m[i, k].fill(0.0)
            self.sh_v[i, k].fill(0.0)
        self.steps[i] = 0
        self.touched[i] = 0
        self.coverage[i] = 0.0

    @ti.kernel
    def _write(
        self,
        first: ti.i32,
        anchor: ti.i32,
        position: ti.types.ndarray(),
        log_scale: ti.types.ndarray(),
        quaternion: ti.types.ndarray(),
        opacity_logit: ti.types.ndarray(),
        sh: ti.types.ndarray(),
    ):
        for j in range(opacity_logit.shape[0]):
            i = first + j
            for c in ti.static(range(3)):
                self.position[i][c] = position[j, c]
                self.log_scale[i][c] = log_scale[j, c]
            for c in ti.static(range(4)):
                self.quaternion[i][c] = quaternion[j, c]
            self.opacity_logit[i] = opacity_logit[j]
            for k in range(self.sh_count):
                for c in ti.static(range(3)):
                    self.sh[i, k][c] = sh[j, k, c]
            self._forget(i)
            self.anchor[i] = anchor

    @ti.kernel
    def _move(self, source: ti.types.ndarray(), target: ti.types.ndarray()):
        for j in range(source.shape[0]):
            s, t = source[j], target[j]
            self._forget(t)
            self.position[t] = self.position[s]
            self.position_m[t] = self.position_m[s]
            self.position_v[t] = self.position_v[s]
            self.log_scale[t] = self.log_scale[s]
            self.log_scale_m[t] = self.log_scale_m[s]
            self.log_scale_v[t] = self.log_scale_v[s]
            self.quaternion[t] = self.quaternion[s]
            self.quaternion_m[t] = self.quaternion_m[s]
            self.quaternion_v[t] = self.quaternion_v[s]
            self.opacity_logit[t] = self.opacity_logit[s]
            self.opacity_logit_m[t] = self.opacity_logit_m[s]
            self.opacity_logit_v[t] = self.opacity_logit_v[s]
            for k in range(self.sh_count):
                self.sh[t, k] = self.sh[s, k]
                self.sh_m[t, k] = self.sh_m[s, k]
                self.sh_v[t, k] = self.sh_v[s, k]
            self.steps[t] = self.steps[s]
            self.anchor[t] = self.anchor[s]
            self.coverage[t] = self.coverage[s]


_NAMES = ("position", "log_scale", "quaternion", "opacity_logit", "sh")
