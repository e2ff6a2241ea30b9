"""Refinement of one region of a finished map."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import NO_ANCHOR
from pipelines.densify.densifier import Anchor
from pipelines.finished_map import FinishedMap, take_in_frames
from pipelines.online_map import OnlineMap
from pipelines.refinement import refine
from pipelines.settings import RefineSettings

__all__ = ["RefinedRegion", "Span", "refine_region", "with_history"]

# Pyramid level at which it is measured how much of each view a region fills.
COARSE = 1
# Anchor of a region's own Gaussians while it is refined. The others have none.
OWN = 0


@dataclass(frozen=True)
class Span:
    """Steps of a round of refinement, counted over all rounds.

    Attributes:
        first: Number of steps before it.
        end: Number of steps after it.
        total: Number of steps of all rounds.
    """

    first: int
    end: int
    total: int

    def schedule(self, step: int) -> float | None:
        """Return the share of the refinement that has passed before a step, None after the last step of the span."""
        return step / max(self.total - 1, 1) if step < self.end else None


@dataclass(frozen=True)
class RefinedRegion:
    """A region after a round.

    Attributes:
        gaussians: Its own Gaussians with their optimiser state, in the form of `GaussianField.extend`.
        exposures: Exposure (3, 4) of each of its views, by frame index; empty if none is estimated.
        shares: How much of each of its views (0 to 1) is filled by its own Gaussians, by frame index.
        view_renders: Number of views that were rendered and differentiated.
    """

    gaussians: dict[str, NDArray]
    exposures: dict[int, NDArray[np.float64]]
    shares: dict[int, float]
    view_renders: int


def with_history(gaussians: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Return Gaussians, in the form of `GaussianField.to_numpy`, with the optimiser state of new ones."""
    count = len(gaussians["position"])
    moments = {name + end: np.zeros_like(array) for name, array in gaussians.items() for end in ("_m", "_v")}
    numbers = {"steps": np.zeros(count, dtype=np.int32), "anchor": np.full(count, NO_ANCHOR, dtype=np.int32)}
    return {**gaussians, **moments, **numbers}


def refine_region(
    mapper: OnlineMap,
    finished: FinishedMap,
    own: NDArray[np.bool_],
    settings: RefineSettings,
    span: Span,
    progress: Callable[[int, float], None] | None = None,
) -> RefinedRegion:
    """Optimise the Gaussians of a region on the views that see it, see `pipelines.refinement.refine`.

    The Gaussians around the region, which its views see as well, are optimised with it, and then given up: the regions
    that they belong to have their own results for them. Views are drawn in proportion to the share of their images that
    the region fills. Poses are kept.

    Args:
        mapper: A new map, without frames.
        finished: The views, and the Gaussians of the region and around it, with their optimiser state.
        own: Whether each Gaussian (N,) belongs to the region.
        settings: Settings of the refinement.
        span: The steps of this round.
        progress: Called after every step with (steps done, mean PSNR of its views).

    Raises:
        ValueError: If the Gaussians do not fit the settings of the map, or there is no view.
    """
    take_in_frames(mapper, finished)
    mapper.gaussians.restore({**finished.gaussians, "anchor": np.where(own, OWN, NO_ANCHOR)})
    mapper.densifier.anchors = [Anchor(mapper.keyframes[0], mapper.keyframes[0].view_scale)]
    for view in mapper.keyframes:
        values = mapper.optimiser.compare(view, mapper.keyframes.scene_depth)
        if np.isfinite(values.l1):
            view.error = values.l1
    shares = _shares(mapper)
    if shares.any():
        if span.first:  # masks are found before the first step only
            mapper.mask_contradicted(np.arange(len(mapper.keyframes)))
        held = settings.model_copy(update={"poses": False})
        refine(mapper, held, progress, span.first, span.schedule, shares)
    kept = mapper.gaussians.anchors() == OWN
    state = mapper.gaussians.to_numpy() | mapper.gaussians.history()
    return RefinedRegion(
        gaussians={name: array[kept] for name, array in state.items()},
        exposures={view.index: view.exposure for view in mapper.keyframes if view.exposure is not None},
        shares=dict(zip((view.index for view in mapper.keyframes), shares.tolist(), strict=True)),
        view_renders=mapper.renderer.view_renders,
    )


def _shares(mapper: OnlineMap) -> NDArray[np.float64]:
    """Return the share (K,) of the weight of all Gaussians in each view that the region's own ones have."""
    contribution, shares = mapper.hidden.contribution, np.zeros(len(mapper.keyframes))
    own = mapper.gaussians.anchors() == OWN
    for place, view in enumerate(mapper.keyframes):
        contribution.begin()
        contribution.measure([view], mapper.near, COARSE)
        coverage = mapper.gaussians.coverages().astype(np.float64)
        shares[place] = coverage[own].sum() / max(coverage.sum(), 1e-9)
    return shares
