"""Initial Gaussians and adaptive density control of 3DGS [Kerbl 2023, Sections 5.1 and 5.2], for the baseline."""
# pyright: reportInvalidTypeForm=false

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.buffers.view import ProjectedGaussians, ViewField
from fields.map.gaussians import SH_C0, GaussianField
from fields.map.keyframe import Keyframe
from fields.runtime.engine import ti
from pipelines.companions.exposure import scene_colours
from pipelines.settings import OfflineSettings

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
        """Add the gradients of the rendered view, after compositing's backward pass and before projection's."""
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


NEIGHBOURS = 3
# FLANN's identifier of a single k-d tree, whose search is exact.
KDTREE_SINGLE = 4


@dataclass(frozen=True)
class PointCloud:
    """Coloured points.

    Attributes:
        xyz: Positions (N, 3) in the world frame.
        colour: Scene colours (N, 3) [1 = white].
    """

    xyz: NDArray[np.float64]
    colour: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.xyz)


def union_of_points(views: Iterable[Keyframe]) -> PointCloud:
    """Collect every tracked point once, ordered by id.

    Position and colour are taken from the last view that has the point on a valid pixel, since trackers refine their
    points over time.
    """
    ids, xyz, colour = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))], [np.zeros((0, 3))]
    for view in views:
        points = view.points
        inside = np.flatnonzero(view.camera.contains(points.pixels))
        places = np.floor(points.pixels[inside]).astype(int)
        valid = view.rgba[places[:, 1], places[:, 0], 3] > 0
        ids.append(points.ids[inside[valid]])
        xyz.append(points.xyz[inside[valid]])
        colour.append(scene_colours(view, places[valid]))
    every = np.concatenate(ids)
    _, first_from_the_end = np.unique(every[::-1], return_index=True)
    last = len(every) - 1 - first_from_the_end
    return PointCloud(np.concatenate(xyz)[last], np.concatenate(colour)[last])


def spacing(xyz: NDArray[np.float64], neighbours: int = NEIGHBOURS) -> NDArray[np.float64]:
    """Mean distance (N,) of each point (N, 3) to its nearest neighbours. Raises ValueError if there are too few."""
    if len(xyz) <= neighbours:
        raise ValueError(f"{len(xyz)} points have no {neighbours} neighbours each")
    # FLANN works in float32. Centring keeps its precision independent of the world's origin.
    centred = np.ascontiguousarray(xyz - np.median(xyz, axis=0), dtype=np.float32)
    tree = cv2.flann.Index(centred, {"algorithm": KDTREE_SINGLE})
    _, squares = tree.knnSearch(centred, neighbours + 1)
    # The first neighbour is the point itself.
    return np.sqrt(squares[:, 1:].astype(np.float64)).mean(axis=1)


def initialise(gaussians: GaussianField, points: PointCloud, opacity: float, smallest: float) -> None:
    """Add one isotropic Gaussian per point, with the mean distance to its neighbours as its standard deviation.

    If the pool is too small for all points, evenly spaced ones are used.

    Args:
        gaussians: Field to add to.
        points: The points.
        opacity: Initial opacity.
        smallest: Lower bound on the standard deviation [scene units], for coincident points.

    Raises:
        ValueError: If there are too few points for `spacing`.
    """
    n = min(len(points), gaussians.capacity - gaussians.count)
    chosen = np.arange(n) * len(points) // max(n, 1)
    xyz = points.xyz[chosen]
    size = np.maximum(spacing(xyz), smallest)
    sh = np.zeros((n, gaussians.sh_count, 3))
    sh[:, 0] = (points.colour[chosen] - 0.5) / SH_C0
    gaussians.append(
        position=xyz,
        log_scale=np.repeat(np.log(size)[:, None], 3, axis=1),
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        opacity_logit=np.full(n, np.log(opacity / (1.0 - opacity))),
        sh=sh,
    )
