"""Adaptive density control of 3DGS [Kerbl 2023, Section 5.2]: clone, split, prune, reset opacities."""

from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from fields.buffers.projected import ProjectedGaussians
from fields.buffers.view import ViewField
from fields.map.gaussians import GaussianField
from pipelines.settings import OfflineSettings

__all__ = ["Adaptation", "AdaptiveDensity", "GradientStatistics"]

# A split makes two Gaussians, each smaller by this.
SPLIT_SHRINK = 1.6


class Adaptation(NamedTuple):
    """How many Gaussians one round cloned, split in two and removed for their opacity or size."""

    cloned: int
    split: int
    pruned: int


@ti.data_oriented
class GradientStatistics:
    """Per Gaussian, the sum over views of |d loss / d mean| in the image, and the number of views that saw it.

    The gradient is by the mean in half images (NDC), so that its threshold holds for any image size.
    """

    def __init__(self, capacity: int, real=ti.f32) -> None:
        self.capacity = capacity
        self.gradient = ti.field(real, capacity)
        self.views = ti.field(ti.i32, capacity)

    def observe(self, projected: ProjectedGaussians, view: ViewField) -> None:
        """Take in the view whose gradients are in `projected`: after compositing's backward, before projection's."""
        if projected.count:
            self._observe(projected.seen, projected.gaussian, projected.mean.grad, 0.5 * view.width, 0.5 * view.height)

    def mean(self, count: int) -> NDArray[np.float64]:
        """Mean norm of the first `count` Gaussians (count,); 0 where no view saw one."""
        views = self.views.to_numpy()[:count]
        return self.gradient.to_numpy()[:count].astype(np.float64) / np.maximum(views, 1)

    def clear(self) -> None:
        """Forget all views."""
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
            # A Gaussian has one slot a view: no other thread writes here.
            self.gradient[i] = self.gradient[i] + ti.sqrt(x * x + y * y)
            self.views[i] = self.views[i] + 1


@ti.data_oriented
class AdaptiveDensity:
    """Grows and thins a `GaussianField` by the statistics of the views since the last round."""

    def __init__(self, gaussians: GaussianField, settings: OfflineSettings, rng: np.random.Generator) -> None:
        self.gaussians = gaussians
        self.settings = settings
        self.statistics = GradientStatistics(gaussians.capacity, gaussians.real)
        self._rng = rng

    def adapt(self, extent: float, prune_large: bool) -> Adaptation:
        """One round: clone, split, prune; the statistics then start anew.

        Of the Gaussians whose mean gradient reaches the threshold, a small one gets a copy in the same place, a large
        one is replaced by two smaller ones drawn from it. Then transparent Gaussians go, and with `prune_large` too
        large ones. New Gaussians have no history. Where the pool is too small, the largest gradients come first.

        extent: of the scene [scene units], which the settings' sizes are relative to.
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
        self.gaussians.append(**{name: value[enters] for name, value in new.items()})
        self.statistics.clear()
        pruned = int(np.count_nonzero(~stays & ~split)) + int(np.count_nonzero(~enters))
        return Adaptation(int(clone.sum()), int(split.sum()), pruned)

    def reset_opacities(self) -> None:
        """Lower all opacities to `reset_opacity` at most and forget their moments: what is needed comes back."""
        ceiling = self.settings.reset_opacity
        if self.gaussians.count:
            self._reset(self.gaussians.count, float(np.log(ceiling / (1.0 - ceiling))))

    def _within_the_pool(self, gradient: NDArray, wanted: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Of the Gaussians that want to grow, those that there is room for: each adds one."""
        room = self.gaussians.capacity - self.gaussians.count
        if np.count_nonzero(wanted) <= room:
            return wanted
        chosen = np.argsort(np.where(wanted, -gradient, np.inf), kind="stable")[:room]
        return np.isin(np.arange(len(wanted)), chosen)

    def _child(self, parents: dict[str, NDArray]) -> dict[str, NDArray]:
        """Place and size of a Gaussian drawn from each parent; the rest it inherits."""
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
