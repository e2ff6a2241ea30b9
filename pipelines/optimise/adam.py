"""Adam over the Gaussians that the last batch of views saw, and over small vectors of keyframes."""
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOptionalCall=false, reportOptionalSubscript=false

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import GaussianField
from fields.runtime.compiled_kernel import CompiledLoop
from fields.runtime.engine import ti

# Bits of 1e18 in float32, whose square (a second moment) is still finite.
BOUND = int(np.float32(1e18).view(np.int32))
LARGEST_LOG = 80.0
# Logit of an opacity below every pruning threshold.
TRANSPARENT = -20.0


@dataclass(frozen=True)
class LearningRates:
    """Step sizes of Adam.

    Attributes:
        position: Step of positions [scene units].
        log_scale: Step of log-scales.
        quaternion: Step of quaternions.
        opacity_logit: Step of opacity logits.
        colour: Step of the constant harmonic; the others use a twentieth of it.
    """

    position: float
    log_scale: float
    quaternion: float
    opacity_logit: float
    colour: float


@ti.func
def bits(x):
    """The bits of |x| as float32, which order like the values, with infinity and NaN above all.

    A comparison of floats would not detect NaN, since the compiler may assume that there is none (fast math).
    """
    return ti.bit_cast(ti.cast(x, ti.f32), ti.i32) & 0x7FFFFFFF


@ti.func
def one_over_complement(x):
    """1 / (1 - exp(x)) for x < 0, by a series near 0, where the difference would lose all precision."""
    series = -x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x * (1.0 / 24.0))))
    return 1.0 / ti.select(x > -0.05, series, 1.0 - ti.exp(x))


@ti.data_oriented
class Adam:
    """Adam [Kingma 2015] with a separate step count per Gaussian for the bias correction.

    For a batch of B views, the rates follow the square-root rule of the paper's settings: lr * sqrt(B), betas 1 - 0.1 B
    and 1 - 0.001 B, eps / sqrt(B). A Gaussian that no view saw keeps its values, moments and step count.

    Two safeguards check every Gaussian. If its gradient contains NaN or Inf, or its components sum to more than 1e18 in
    magnitude, the step is skipped. If a Gaussian becomes larger than allowed, it is made transparent, so that the next
    pruning removes it. Both are counted, see `GaussianField.take_caught`.
    """

    def __init__(self, gaussians: GaussianField) -> None:
        self.gaussians = gaussians
        self.real = gaussians.real
        self._update_all = CompiledLoop(self._step, 60)

    def step(self, rates: LearningRates, batch: int = 1, sh_degree: int | None = None, largest: float = np.inf) -> None:
        """Update every Gaussian that has gradients, and clear the gradients.

        Args:
            rates: Step sizes for a batch of one view.
            batch: Number of views whose gradients were accumulated.
            sh_degree: Highest degree of the harmonics that are updated; None for all.
            largest: Largest standard deviation of a Gaussian [scene units].
        """
        if self.gaussians.count == 0:
            return
        active = self.gaussians.sh_count if sh_degree is None else (sh_degree + 1) ** 2
        root = float(np.sqrt(batch))
        beta1, beta2 = max(1.0 - 0.1 * batch, 0.0), 1.0 - 0.001 * batch
        values = [rates.position, rates.log_scale, rates.quaternion, rates.opacity_logit, rates.colour]
        steps = (float(root * v) for v in values)
        # beta^t is computed as exp(t log beta), which is cheaper than a power. A beta of 0 is replaced by 1e-30, whose
        # powers vanish as well.
        logs = (float(np.log(max(beta, 1e-30))) for beta in (beta1, beta2))
        n = self.gaussians.count
        limit = float(min(np.log(largest), LARGEST_LOG))
        self._update_all(n, n, active, *steps, float(beta1), float(beta2), *logs, 1e-15 / root, limit)

    @ti.func
    def _update(self, value, gradient, m: ti.template(), v: ti.template(), lr, betas, corrections, eps):
        m = betas[0] * m + (1.0 - betas[0]) * gradient
        v = betas[1] * v + (1.0 - betas[1]) * gradient * gradient
        return value - lr * (m * corrections[0]) / (ti.sqrt(v * corrections[1]) + eps)

    @ti.func
    def _update_field(self, i, value: ti.template(), m: ti.template(), v: ti.template(), lr, betas, corrections, eps):
        value[i] = self._update(value[i], value.grad[i], m[i], v[i], lr, betas, corrections, eps)

    # Fifteen scalars instead of one array: on CUDA, Taichi would copy a NumPy array in both directions and wait for it.
    @ti.kernel
    def _step(
        self,
        alone: ti.template(),
        count: ti.i32,
        active: ti.i32,
        lr_position: ti.f32,
        lr_log_scale: ti.f32,
        lr_quaternion: ti.f32,
        lr_opacity: ti.f32,
        lr_colour: ti.f32,
        beta1: ti.f32,
        beta2: ti.f32,
        log_beta1: ti.f32,
        log_beta2: ti.f32,
        eps: ti.f32,
        largest: ti.f32,
    ):
        ti.loop_config(serialize=alone)
        for i in range(count):
            sound = False
            if self.gaussians.touched[i] != 0:
                self.gaussians.touched[i] = 0
                sound = self._magnitude(i, active) < BOUND
                if not sound:
                    ti.atomic_add(self.gaussians._caught[0], 1)
                    self.gaussians.forget_gradient(i)
            if sound:
                self.gaussians.steps[i] = self.gaussians.steps[i] + 1
                t = ti.cast(self.gaussians.steps[i], ti.f32)
                betas = ti.Vector([beta1, beta2])
                corrections = ti.Vector([one_over_complement(t * log_beta1), one_over_complement(t * log_beta2)])
                # Vectors, and not components, since unrolled code compiles slowly in Taichi.
                g = self.gaussians
                self._update_field(i, g.position, g.position_m, g.position_v, lr_position, betas, corrections, eps)
                self._update_field(i, g.log_scale, g.log_scale_m, g.log_scale_v, lr_log_scale, betas, corrections, eps)
                self._update_field(
                    i, g.quaternion, g.quaternion_m, g.quaternion_v, lr_quaternion, betas, corrections, eps
                )
                self._update_field(
                    i, g.opacity_logit, g.opacity_logit_m, g.opacity_logit_v, lr_opacity, betas, corrections, eps
                )
                for k in range(active):
                    # The view-dependent part has a twentieth of the rate, as in 3DGS.
                    lr = ti.select(k == 0, lr_colour, lr_colour / 20.0)
                    g.sh[i, k] = self._update(
                        g.sh[i, k], g.sh.grad[i, k], g.sh_m[i, k], g.sh_v[i, k], lr, betas, corrections, eps
                    )
                self.gaussians.forget_gradient(i)
                if self.gaussians.log_scale[i].max() > largest:
                    self.gaussians.log_scale[i] = ti.min(self.gaussians.log_scale[i], largest)
                    self.gaussians.opacity_logit[i] = TRANSPARENT
                    ti.atomic_add(self.gaussians._caught[1], 1)

    @ti.func
    def _magnitude(self, i, active):
        """Sum of the magnitudes of a Gaussian's gradient, as bits (see `bits`)."""
        g = self.gaussians
        total = ti.abs(g.opacity_logit.grad[i]) + ti.abs(g.position.grad[i]).sum() + ti.abs(g.log_scale.grad[i]).sum()
        total += ti.abs(g.quaternion.grad[i]).sum()
        for k in range(active):
            total += ti.abs(g.sh.grad[i, k]).sum()
        return bits(total)


@ti.data_oriented
class AspectPenalty:
    """Penalty on Gaussians with an aspect ratio above 10:1 (the paper's supplementary settings).

    The penalty is weight / N * sum over the touched Gaussians of max(0, s_max - 10 s_min)^2, with scales s in scene
    depths.
    """

    def __init__(self, gaussians: GaussianField, max_ratio: float = 10.0) -> None:
        self.gaussians = gaussians
        self.max_ratio = max_ratio
        self._add = CompiledLoop(self._backward, 20)

    def backward(self, weight: float, scene_depth: float) -> None:
        """Add the gradient of the penalty to the gradients of the log-scales.

        Args:
            weight: Weight of the penalty.
            scene_depth: Depth of the scene [scene units].
        """
        count = self.gaussians.count
        if count:
            self._add(count, count, weight / count, 1.0 / float(scene_depth))

    @ti.kernel
    def _backward(self, alone: ti.template(), count: ti.i32, weight: ti.f64, per_depth: ti.f64):
        ti.loop_config(serialize=alone)
        for i in range(count):
            if self.gaussians.touched[i] != 0:
                scale = ti.exp(self.gaussians.log_scale[i]) * ti.cast(per_depth, self.gaussians.real)
                longest, shortest = scale.max(), scale.min()
                excess = longest - self.max_ratio * shortest
                if excess > 0.0:
                    pull = 2.0 * ti.cast(weight, self.gaussians.real) * excess
                    for c in ti.static(range(3)):
                        is_longest = ti.cast(scale[c] == longest, self.gaussians.real)
                        is_shortest = ti.cast(scale[c] == shortest, self.gaussians.real)
                        gradient = pull * scale[c] * (is_longest - self.max_ratio * is_shortest)
                        self.gaussians.log_scale.grad[i][c] = self.gaussians.log_scale.grad[i][c] + gradient


class Moments:
    """Adam's moments by frame index.

    Args:
        shape: Shape S of what is optimised.

    Attributes:
        steps: Number of steps of each keyframe that has made any.
    """

    BETAS = (0.9, 0.999)

    def __init__(self, *shape: int) -> None:
        self._shape = shape
        self._first: dict[int, NDArray[np.float64]] = {}
        self._second: dict[int, NDArray[np.float64]] = {}
        self.steps: dict[int, int] = {}

    def step(self, index: int, gradient: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
        """Take in the gradient (S) of a keyframe, and return what to subtract (S)."""
        beta1, beta2 = self.BETAS
        count = self.steps[index] = self.steps.get(index, 0) + 1
        none = np.zeros(self._shape)
        m = self._first[index] = beta1 * self._first.get(index, none) + (1 - beta1) * gradient
        v = self._second[index] = beta2 * self._second.get(index, none) + (1 - beta2) * gradient**2
        return rate * (m / (1 - beta1**count)) / (np.sqrt(v / (1 - beta2**count)) + 1e-15)

    def of(self, index: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return both moments of a keyframe (S, flat) and its number of steps (1,)."""
        none = np.zeros(self._shape)
        m, v = (table.get(index, none).ravel() for table in (self._first, self._second))
        return m, v, np.array([self.steps.get(index, 0)], dtype=np.float64)

    def put(self, index: int, first: NDArray[np.float64], second: NDArray[np.float64], steps: int) -> None:
        """Replace the moments of a keyframe (S) and its number of steps; with none, it is forgotten."""
        self._first[index], self._second[index], self.steps[index] = first, second, steps
        if steps == 0:
            self.forget(index)

    def forget(self, index: int) -> None:
        """Forget the steps of a keyframe."""
        for table in (self._first, self._second, self.steps):
            table.pop(index, None)

    def state(self) -> dict[str, NDArray]:
        """Return the moments as arrays, for `restore`."""
        tables = {"m": self._first, "v": self._second}
        return {
            "index": np.array(list(self.steps), dtype=np.int64),
            "steps": np.array(list(self.steps.values()), dtype=np.int64),
            **{name: np.array(list(of.values())).reshape(-1, *self._shape) for name, of in tables.items()},
        }

    def restore(self, state: Mapping[str, NDArray]) -> None:
        """Restore the result of `state`."""
        index = state["index"].tolist()
        self.steps = dict(zip(index, state["steps"].tolist(), strict=True))
        self._first, self._second = (dict(zip(index, np.array(state[name]), strict=True)) for name in ("m", "v"))
