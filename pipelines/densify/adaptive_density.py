"""Adaptive density control of 3DGS [Kerbl 2023, Section 5.2]: clone, split, prune, reset opacities."""
# pyright: reportInvalidTypeForm=false

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fields.buffers.projected import ProjectedGaussians
from fields.buffers.view import ViewField
from fields.map.gaussians import GaussianField
from fields.runtime.engine import ti
from pipelines.offline_settings import OfflineSettings

# A split divides the scales of a Gaussian by this factor.
SPLIT_SHRINK = 1.6


class Adaptation(NamedTuple):
    """Numbers of Gaussians that one round cloned, split in two, and pruned by opacity or size."""

    cloned: int
    split: int
    pruned: int


@ti.data_oriented
class GradientStatistics:
    """Per Gaussian, the sum over views of the 2D positional gradient's norm, and the number of views that saw it.

    The gradient is taken with respect to the projected mean in half images (NDC), so that its threshold does not depend
    on the image size.
    """

    def __init__(self, capacity: int, real=ti.f32) -> None:
        self.capacity = capacity
        self.gradient = ti.field(real, capacity)
        self.views = ti.field(ti.i32, capacity)

    def observe(self, projected: ProjectedGaussians, view: ViewField) -> None:
        """Add the gradients of one view.

        Call it after compositing's backward pass and before projection's.

        Args:
            projected: Projected Gaussians of the view, with their gradients.
            view: The view that was rendered.
        """
        if projected.count:
            self._observe(projected.seen, projected.gaussian, projected.mean.grad, 0.5 * view.width, 0.5 * view.height)

    def mean(self, count: int) -> NDArray[np.float64]:
        """Mean gradient norm (count,) of the first `count` Gaussians; 0 for a Gaussian that no view saw."""
        views = self.views.to_numpy()[:count]
        return self.gradient.to_numpy()[:count].astype(np.float64) / np.maximum(views, 1)

    def clear(self) -> None:
        """Reset the statistics to zero."""
        self.gradient.fill(0)
        self.views.fill(0)

    @ti.kernel
    def _observe(
        self,
        seen: ti.template(),
        gaussian: ti.template(),
        gradient: ti.template(),
        half_width: ti.f32,
        half_height: ti.f32,
    ):
        for s in range(seen[None]):
            i = gaussian[s]
            x, y = gradient[s][0] * half_width, gradient[s][1] * half_height
            # A Gaussian has one slot per view, so that no other thread writes here.
            self.gradient[i] = self.gradient[i] + ti.sqrt(x * x + y * y)
            self.views[i] = self.views[i] + 1


@ti.data_oriented
class AdaptiveDensity:
    """Clones, splits and prunes the Gaussians of a `GaussianField`, by gradients gathered since the last round."""

    def __init__(self, gaussians: GaussianField, settings: OfflineSettings, rng: np.random.Generator) -> None:
        self.gaussians = gaussians
        self.settings = settings
        self.statistics = GradientStatistics(gaussians.capacity, gaussians.real)
        self._rng = rng

    def adapt(self, extent: float, prune_large: bool) -> Adaptation:
        """Run one round of cloning, splitting and pruning, and clear the statistics.

        A Gaussian grows if its mean gradient reaches the threshold: a small one is cloned in place, a large one is
        replaced by two smaller ones sampled from it. If the pool is too small for all, those with the largest gradients
        grow. New Gaussians have zero moments and step counts. Transparent Gaussians are then removed.

        Args:
            extent: Extent of the scene [scene units], the unit of the sizes in the settings.
            prune_large: Also remove Gaussians longer than `prune_size` extents.

        Returns:
            Numbers of Gaussians cloned, split and pruned.
        """
        s = self.settings
        state = self.gaussians.to_numpy()
        gradient = self.statistics.mean(self.gaussians.count)
        longest = np.exp(state["log_scale"].max(axis=1))
        grows = self._within_the_pool(gradient, gradient >= s.gradient_threshold)
        clone, split = grows & (longest <= s.clone_size * extent), grows & (longest > s.clone_size * extent)

        parents = {name: value[split] for name, value in state.items()}
        children = [parents | self._child(parents) for _ in range(2)]
        copies = {name: value[clone] for name, value in state.items()}
        new = {name: np.concatenate([part[name] for part in (copies, *children)]) for name in state}

        limit = s.prune_size * extent if prune_large else np.inf
        stays, enters = self._worth_keeping(state, limit), self._worth_keeping(new, limit)
        self.gaussians.remove(stays & ~split)
        new = {name: value[enters] for name, value in new.items()}
        self.gaussians.append(new["position"], new["log_scale"], new["quaternion"], new["opacity_logit"], new["sh"])
        self.statistics.clear()
        pruned = int(np.count_nonzero(~stays & ~split)) + int(np.count_nonzero(~enters))
        return Adaptation(int(clone.sum()), int(split.sum()), pruned)

    def reset_opacities(self) -> None:
        """Clamp all opacities to `reset_opacity` and zero their moments. Gaussians that are needed recover."""
        ceiling = self.settings.reset_opacity
        if self.gaussians.count:
            self._reset(self.gaussians.count, float(np.log(ceiling / (1.0 - ceiling))))

    def _within_the_pool(self, gradient: NDArray, wanted: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Restrict `wanted` to as many Gaussians as the pool has room for. Each growing Gaussian adds one."""
        room = self.gaussians.capacity - self.gaussians.count
        if np.count_nonzero(wanted) <= room:
            return wanted
        chosen = np.argsort(np.where(wanted, -gradient, np.inf), kind="stable")[:room]
        return np.isin(np.arange(len(wanted)), chosen)

    def _child(self, parents: dict[str, NDArray]) -> dict[str, NDArray]:
        """Sample a position from each parent and shrink its scale. The other values are inherited."""
        offset = np.exp(parents["log_scale"]) * self._rng.standard_normal(parents["position"].shape)
        q = parents["quaternion"] / np.linalg.norm(parents["quaternion"], axis=1, keepdims=True)
        turned = np.cross(q[:, 1:], offset)
        offset = offset + 2.0 * (q[:, :1] * turned + np.cross(q[:, 1:], turned))
        return {
            "position": parents["position"] + offset,
            "log_scale": parents["log_scale"] - np.log(SPLIT_SHRINK),
        }

    def _worth_keeping(self, state: dict[str, NDArray], largest: float) -> NDArray[np.bool_]:
        opacity = 1.0 / (1.0 + np.exp(-state["opacity_logit"]))
        return (opacity >= self.settings.prune_opacity) & (np.exp(state["log_scale"].max(axis=1)) <= largest)

    @ti.kernel
    def _reset(self, count: ti.i32, ceiling: ti.f32):
        for i in range(count):
            self.gaussians.opacity_logit[i] = ti.min(self.gaussians.opacity_logit[i], ceiling)
            self.gaussians.opacity_logit_m[i] = 0.0
            self.gaussians.opacity_logit_v[i] = 0.0
