"""`Densifier`: adds Gaussians from a view, and remembers which view placed them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from fields.voxels.occupancy import OccupancyVoxels
from pipelines.densify.depth.estimate import DepthEstimator
from pipelines.densify.growth import HOLE, Seeds, dissimilarity, error_pixels, grow, pixel_seeds, tracked_seeds
from pipelines.densify.sky import sky_pixels, sky_seeds
from pipelines.optimise.map_optimiser import MapOptimiser
from pipelines.pipeline import Stopwatch
from pipelines.safeguards import MemoryBudget
from pipelines.settings import MappingSettings

# Gaussians whose voxels are marked together, before those rest of which no Gaussian is resident.
MARKED_TOGETHER = 1 << 17


@dataclass(slots=True)
class Anchor:
    """A view that placed Gaussians.

    Attributes:
        keyframe: Keyframe that these Gaussians move with.
        spacing: Target voxel size of the view [scene units].
    """

    keyframe: Keyframe
    spacing: float


class Densifier:
    """Adds Gaussians at tracked points and at pixels of high error, both filtered by the occupancy voxels.

    Each Gaussian stores the view that placed it (`GaussianField.anchor`, an index into `anchors`).

    Args:
        settings: Settings of the mapping.
        optimiser: Optimiser of the map; its renderer draws the views.
        keyframes: The keyframes of the map.
        depth: Depth estimator.
        rng: Random generator.
        stopwatch: Stopwatch of the mapper.

    Attributes:
        voxels: Occupancy voxels; None if the settings disable them.
        budget: Memory budget of the map.
        anchors: The views that placed Gaussians.
    """

    def __init__(
        self,
        settings: MappingSettings,
        optimiser: MapOptimiser,
        keyframes: KeyframeStore,
        depth: DepthEstimator,
        rng: np.random.Generator,
        stopwatch: Stopwatch,
    ) -> None:
        self.settings = settings
        self.optimiser = optimiser
        self.gaussians = optimiser.gaussians
        self.keyframes = keyframes
        self.depth = depth
        v = settings.voxels
        self.voxels = OccupancyVoxels(levels=v.levels, resolution=v.resolution) if v.enabled else None
        limit = None if settings.memory is None else settings.memory * 1e9
        self.budget = MemoryBudget(limit, self.gaussians, keyframes, self.voxels, optimiser.safeguards)
        self.anchors: list[Anchor] = []
        self._rng = rng
        self._stopwatch = stopwatch

    def add_tracked_points(self, view: Keyframe) -> None:
        """Add Gaussians at the tracked points of a view, which becomes an anchor."""
        self.anchors.append(Anchor(self.keyframes[-1], self.settings.voxels.target * view.view_scale))
        self._grow(tracked_seeds(view), view, len(self.anchors) - 1)

    def add_error_pixels(self, view: Keyframe, warming_up: bool, share: float = 1.0) -> None:
        """Add Gaussians at a keyframe's pixels of high error and where it may show sky. First, `add_tracked_points`.

        Args:
            view: The keyframe, or a level of it. Of an earlier one, depth is matched in later keyframes as well.
            warming_up: Whether the map is too young to render; pixels are then drawn from the whole image.
            share: Share of `densify.pixels` that is drawn.
        """
        with self._stopwatch.measure("depth"):
            self.optimiser.compare(view, self.keyframes.scene_depth)
            images = self.optimiser.renderer.images
            error = None if warming_up else dissimilarity(images.colour_to_numpy(), view.rgba)
            opacity = images.opacity_to_numpy()
            pixels = error_pixels(view, error, self.settings.densify, self._rng, share)
            count = len(pixels)
            sky = sky_pixels(view, opacity) if self.settings.densify.sky else np.zeros((0, 2))
            column, row = np.floor(pixels).astype(int).T
            depth = self.settings.depth
            limit = np.where(opacity[row, column] < HOLE, depth.hole_deviation, depth.max_deviation)
            neighbours = self.keyframes.around(view.index, depth.neighbours)
            estimate = self.depth.estimate(view, neighbours, np.concatenate([pixels, sky]))
            seeds = pixel_seeds(view, neighbours, pixels, estimate[:count], limit, depth.max_misplacement)
        self._grow(seeds, view, self.first_anchor_since(view))
        # Without voxels, whose cells the wide Gaussians would close for narrow ones.
        seeds = sky_seeds(view, sky, estimate[count:])
        grow(self.gaussians, seeds, None, 0.0, self.settings.densify, self.budget, self.first_anchor_since(view))

    def _grow(self, seeds: Seeds, view: Keyframe, anchor: int) -> None:
        """Add Gaussians at the seeds that the voxels admit. The first seeds settle the voxels around the camera."""
        with self._stopwatch.measure("occupancy"):
            if self.voxels is not None and len(self.gaussians) == 0:
                self.voxels.settle(self.settings.voxels.coarsest * view.view_scale, view.centre)
            spacing = self.settings.voxels.target * view.view_scale
            grow(self.gaussians, seeds, self.voxels, spacing, self.settings.densify, self.budget, anchor)

    def first_anchor_since(self, keyframe: Keyframe) -> int:
        """Return the place of the first anchor of this keyframe or of a frame after it."""
        return bisect_left(self.anchors, keyframe.index, key=lambda anchor: anchor.keyframe.index)

    def anchors_at(self, keyframes: Iterable[Keyframe]) -> NDArray[np.bool_]:
        """Return whether each anchor (A,) is one of these keyframes, or a frame after it and before the next one."""
        wanted = np.isin(
            [keyframe.index for keyframe in self.keyframes.selected], [keyframe.index for keyframe in keyframes]
        )
        return wanted[self.places_of_anchors()]

    def places_of_anchors(self) -> NDArray[np.int64]:
        """Return the place (A,) in `KeyframeStore.selected` of each anchor, or of the keyframe before it."""
        selected = [keyframe.index for keyframe in self.keyframes.selected]
        return np.searchsorted(selected, [anchor.keyframe.index for anchor in self.anchors], side="right") - 1

    def restart_voxels(
        self,
        coarsest: float,
        origin: NDArray[np.float64],
        position: NDArray[np.floating],
        anchor: NDArray[np.int32],
    ) -> None:
        """Clear the voxels and mark those of all Gaussians, each down to the level of its anchor's spacing.

        Args:
            coarsest: New size of the coarsest voxels [scene units].
            origin: New origin (3,) of the voxels in the world frame.
            position: Means (N, 3) of the Gaussians in the world frame, the resident ones first.
            anchor: Their anchors (N,).
        """
        if self.voxels is None:
            return
        self.voxels.clear()
        self.voxels.settle(coarsest, origin)
        spacing = np.array([a.spacing for a in self.anchors] + [self.voxels.coarsest])[anchor]  # -1: the coarsest
        for part in np.array_split(np.arange(len(position)), max(1, len(position) // MARKED_TOGETHER)):
            order = part[np.argsort(spacing[part], kind="stable")]  # on a GPU, `update` runs once per run of levels
            self.voxels.update(position[order], spacing[order])
            if len(position) > len(self.gaussians):
                self.voxels.rest(position[: len(self.gaussians)])
