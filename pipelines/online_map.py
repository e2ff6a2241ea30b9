"""`OnlineMap`: an online map and the objects that work on it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import GaussianField
from fields.map.keyframes import KeyframeStore
from fields.map.trajectory import Trajectory
from fields.runtime.tenancy import in_engine, settled
from fields.voxels.sparse_bricks import SparseBricks
from pipelines.blocks.paging import Paging
from pipelines.companions import Companion
from pipelines.corrections import MapCorrector
from pipelines.densify.contribution import Contribution
from pipelines.densify.densifier import Densifier
from pipelines.densify.depth import DepthEstimator, build_depth
from pipelines.densify.hidden_gaussians import HiddenGaussians
from pipelines.densify.other_places import OtherPlaces
from pipelines.optimise.map_optimiser import MapOptimiser
from pipelines.optimise.safeguards import Safeguards
from pipelines.pace import CompletePace, Pace
from pipelines.pipeline import Pipeline
from pipelines.render.renderer import Renderer
from pipelines.select.gate import FrameGate
from pipelines.select.keyframes import KeyframeSelector
from pipelines.select.views import LocalGlobalViews, ViewSelection
from pipelines.settings import MappingSettings
from pipelines.stopwatch import Stopwatch
from pipelines.transients.changes import ChangeSweep, EarlierVisit
from pipelines.transients.sweep import TransientSweep

__all__ = ["OnlineMap"]


@in_engine("prune", "all_gaussians", "begin_passes", "watch_changes", "caught")
class OnlineMap(Pipeline):
    """An online map and the objects that work on it. `OnlineMapper` adds the loop.

    Args:
        settings: Settings of the mapping.
        max_width: Largest image width [px].
        max_height: Largest image height [px].
        seed: Seed of the random generator.
        depth: Depth estimator; None builds the one that `settings.depth` names.
        views: View selection; None for `LocalGlobalViews`.
        pace: How much work a frame gets; None for all of the settings.
        folder: Folder for the parts of the map that go to disk; None for a temporary one.

    Attributes:
        frame_count: Number of frames processed so far.
        settled: Number of views that `finish` has optimised since the last frame.
        companions: Paging, places, hidden Gaussians, masks: what the loop calls at fixed places, in order.
    """

    can_be_refined: ClassVar[bool] = True

    def __init__(
        self,
        settings: MappingSettings,
        max_width: int,
        max_height: int,
        seed: int = 0,
        depth: DepthEstimator | None = None,
        views: ViewSelection | None = None,
        pace: Pace | None = None,
        folder: Path | None = None,
    ) -> None:
        self.settings = settings
        self.rng = np.random.default_rng(seed)
        self.stopwatch = Stopwatch()
        with settled(nodes=4 + SparseBricks.NODES) as self.tenancy:
            self.gaussians = GaussianField(settings.sh_degree, settings.max_gaussians)
            self.renderer = Renderer(self.gaussians, max_width, max_height, settings.image_cache)
            self.companions: list[Companion] = []  # filled below: some need the optimiser
            self.optimiser = MapOptimiser(self.gaussians, self.renderer, settings, self.companions)
            self.loss = self.optimiser.loss
            self.trajectory = Trajectory()
            self.keyframes = KeyframeStore(
                len(settings.levels.probabilities), settings.levels.min_side, self.trajectory
            )
            self.gate = FrameGate(settings.gate, self.trajectory)
            self.selector = KeyframeSelector(settings.keyframes, self.trajectory)
            depth = depth or build_depth(settings.depth, self.renderer, settings.near, self.rng)
            self.densifier = Densifier(settings, self.optimiser, self.keyframes, depth, self.rng, self.stopwatch)
            self.budget = self.densifier.budget
            self.paging = Paging(self.gaussians, self.keyframes, self.budget, settings, folder)
            contribution = Contribution(self.gaussians, self.renderer)
            self.hidden = HiddenGaussians(contribution, self.densifier, self.paging, settings.densify.min_contribution)
            self.companions += [self.paging, OtherPlaces(self.densifier), self.hidden]
            if settings.transients:
                self.transients = TransientSweep(self.gaussians, self.keyframes, self.renderer, self.paging)
                self.companions.append(self.transients)
            self.pace = pace or CompletePace(settings)
            self.views = views or LocalGlobalViews(settings.views, self.rng)
            self.corrector = MapCorrector(self.keyframes, self.densifier, self.paging)
        self.frame_count = self.settled = 0

    @property
    def near(self) -> float:
        """Depth [scene units] below which nothing is drawn."""
        return self.settings.near * self.keyframes.scene_depth

    @property
    def counts(self) -> tuple[int, int]:
        """Number of keyframes and of frames so far, as `Pace.plan` takes them."""
        return len(self.keyframes.selected), self.frame_count

    @property
    def gaussian_count(self) -> int:
        return self.paging.count

    def all_gaussians(self) -> dict[str, NDArray]:
        return self.paging.to_numpy()

    def prune(self) -> int:
        """Remove Gaussians whose opacity is below `densify.prune_opacity`.

        Returns:
            Number of Gaussians removed.
        """
        return self.gaussians.remove(self.gaussians.opacities() >= self.settings.densify.prune_opacity)

    def begin_passes(self, places: NDArray[np.int64]) -> None:
        """Let the companions look at keyframes before passes over them, see `Companion.before_passes`.

        Args:
            places: Places (N,) of the keyframes in the store.
        """
        with self.stopwatch.measure("remove"):
            for companion in self.companions:
                companion.before_passes(places, self.near)

    def watch_changes(self, earlier: EarlierVisit) -> None:
        """Mask from now on, in the keyframes of an earlier visit, what has changed since.

        Args:
            earlier: The map of the earlier visit.
        """
        changes = ChangeSweep(earlier, self.gaussians, self.keyframes, self.renderer, self.paging)
        self.companions.append(changes)

    def caught(self) -> Safeguards:
        """Return the safeguards' counts so far. Waits for the device."""
        return self.optimiser.caught()

    @property
    def refused(self) -> Mapping[str, int]:
        return self.gate.refused

    def takes_observations(self, count: int) -> bool:
        return self.budget.takes_observations(count)

    def count_beside(self, nbytes: int) -> None:
        self.budget.beside = nbytes
