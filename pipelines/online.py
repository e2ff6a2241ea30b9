"""The online mapping loop: track, add, filter, select views, optimise (the paper's overview figure)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.map.gaussians import GaussianField
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from fields.map.trajectory import Trajectory
from fields.runtime.tenancy import in_engine, settled
from fields.voxels.sparse_bricks import SparseBricks
from pipelines.companions.companion import Companion
from pipelines.companions.hidden_gaussians import Contribution, HiddenGaussians
from pipelines.companions.other_places import OtherPlaces
from pipelines.companions.pace import CompletePace, Pace
from pipelines.companions.paging import Paging
from pipelines.companions.transients import TransientSweep
from pipelines.corrections import CorrectionReport, MapCorrector
from pipelines.densify.densifier import Densifier
from pipelines.densify.depth.estimate import DepthEstimator
from pipelines.densify.depth.sources import build_depth
from pipelines.optimise.map_optimiser import MapOptimiser
from pipelines.pipeline import FrameReport, Pipeline, Stopwatch
from pipelines.refinement import finish
from pipelines.render.renderer import Renderer
from pipelines.safeguards import Safeguards
from pipelines.select.gate import FrameGate
from pipelines.select.keyframes import KeyframeSelector
from pipelines.select.views import LocalGlobalViews, ViewSelection, global_probabilities
from pipelines.settings import MappingSettings
from pipelines.warm_up import warm_up


@in_engine("compile", "process", "optimise", "optimise_further", "correct", "finish")
@in_engine("prune", "all_gaussians", "begin_passes", "caught")
class OnlineMapper(Pipeline):
    """Builds a Gaussian map from a stream of `TrackedFrame`s.

    Functions continue with a map: `pipelines.refinement.refine`, `pipelines.state.save_state` and `restore_state`,
    `pipelines.whole.finished_map.go_on`, `pipelines.whole.merge.merge`.

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

    Example:
        mapper = modp_ti.OnlineMapper(modp_ti.MappingSettings(), max_width=640, max_height=480, seed=0)
        for frame in frames:  # of class `TrackedFrame`
            report = mapper.process(frame)
    """

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

    def compile(self) -> None:
        warm_up(self)

    def process(self, frame: TrackedFrame) -> FrameReport:
        """Process the next frame.

        Raises:
            ValueError: If the frame is held out for evaluation.
        """
        if frame.held_out:
            raise ValueError(f"frame {frame.index} is held out for evaluation and must not touch the map")
        self.frame_count += 1
        self.settled = 0
        self.trajectory.add(frame)
        if self.frame_count % self.settings.densify.prune_every == 0:
            self.prune()
        with self.stopwatch.measure("select"):
            last = next(iter(self.keyframes.before(frame.index, 1)), None)
            if self.gate.refuses(frame, last, self.renderer, self.near):
                return FrameReport(frame.index, False, len(self.keyframes.selected), self.gaussian_count, None)
            is_wanted = self.selector.is_keyframe(frame, last) and self.pace.takes_keyframe()
            for companion in self.companions:
                companion.before_frame(frame, is_wanted)
            is_keyframe = is_wanted and self.budget.takes_keyframe(frame)
        psnr, steps = None, 0
        if is_keyframe:
            psnr, steps = self._add_keyframe(frame)
        elif len(self.keyframes):
            # Other frames only add their tracked points, at a pose corrected by the neighbouring keyframes. Some
            # become views: the more directions the map is optimised from, the better it looks from new ones.
            if self.selector.is_between(frame, self.keyframes) and self.budget.takes_between(frame):
                view = self._append(frame, is_between=True)
            else:
                view = self.keyframes.view(frame)
            self.densifier.add_tracked_points(view)
            if is_wanted:
                # The budget has no room for this keyframe, so the existing ones are optimised instead. Far from them,
                # every frame is selected as a keyframe; each therefore gets only 1 / max_gap of the steps.
                steps = -(-self.pace.plan(0, *self.counts).steps // self.settings.keyframes.max_gap)
                psnr = self._optimise_evenly(self.paging.near(), steps, self.settings.views.per_step)
        return FrameReport(frame.index, is_keyframe, len(self.keyframes.selected), self.gaussian_count, psnr, steps)

    def _append(self, frame: TrackedFrame, is_between: bool = False) -> Keyframe:
        """Add a frame to the views of the map."""
        view = self.keyframes.append(frame, is_between)
        for companion in self.companions:
            companion.after_view(len(self.keyframes) - 1)
        return view

    def _add_keyframe(self, frame: TrackedFrame) -> tuple[float | None, int]:
        """Add a keyframe, add Gaussians from it, and optimise. Returns the last step's mean PSNR, and the steps."""
        view = self._append(frame)
        if len(self.keyframes) > 1 and self.settings.poses.enabled and self.settings.poses.align:
            self.optimiser.poses.align(view)
        with self.stopwatch.measure("optimise"):
            self.optimiser.exposure.begin(self.keyframes, self.renderer, self.near)
        level = self._draw_level(view)
        plan = self.pace.plan(level, *self.counts)
        image = view.at_level(level)
        self.densifier.add_tracked_points(image)
        if self.settings.densify.error_compensation and plan.pixels > 0:
            warming_up = self.frame_count <= self.settings.densify.warm_up
            self.densifier.add_error_pixels(image, warming_up, plan.pixels)
        psnr = self.optimise(plan.steps, level)
        with self.stopwatch.measure("remove"):
            for companion in self.companions:
                companion.after_keyframe(self.near, plan.swept)
        return psnr, plan.steps

    def _draw_level(self, view: Keyframe) -> int:
        """Draw the pyramid level of a new keyframe from the levels that its image has."""
        p = np.array(self.settings.levels.probabilities[: len(view.pyramid)])
        return int(self.rng.choice(len(p), p=p / p.sum()))

    def optimise(self, steps: int, level: int = 0) -> float | None:
        """Optimise the map on the last keyframe and the views selected with it.

        Args:
            steps: Number of optimisation steps.
            level: Pyramid level of the images.

        Returns:
            Mean PSNR of the last step; None if nothing was optimised.
        """
        if len(self.keyframes) == 0 or len(self.gaussians) == 0:
            return None
        poses = self.settings.poses
        with self.stopwatch.measure("select"):
            self.views.begin(self.keyframes, self.paging.near())
        for step in range(steps):
            with self.stopwatch.measure("select"):
                views = self.views.select(self.keyframes)
            with self.stopwatch.measure("optimise"):
                self.optimiser.step(
                    self.keyframes,
                    views,
                    self.optimiser.rates(self.keyframes.scene_depth),
                    pose_rate=poses.learning_rate if poses.enabled and step < poses.steps else 0.0,
                    level=level,
                )
        with self.stopwatch.measure("optimise"):
            return self.optimiser.settle() if steps > 0 else None

    def _optimise_evenly(self, among: NDArray[np.int64], steps: int, views: int) -> float | None:
        """Optimise the map, but no poses, on `views` keyframes per step, drawn from `among` (N,) by error alone.

        Returns the mean PSNR of the last step.
        """
        if len(self.gaussians) == 0 or len(among) == 0:
            return None
        with self.stopwatch.measure("optimise"):
            for _ in range(steps):
                p = global_probabilities(self.keyframes, self.settings.views.error_weight, 0.0, among)
                batch = [int(j) for j in self.rng.choice(among, views, p=p / p.sum())]
                rates = self.optimiser.rates(self.keyframes.scene_depth)
                self.optimiser.step(self.keyframes, batch, rates, pose_rate=0.0)
            return self.optimiser.settle() if steps > 0 else None

    def optimise_further(self) -> float | None:
        """Make one step on views of the whole map, for time in which no frame waits.

        Returns:
            Mean PSNR of its views; None if there is nothing to optimise yet.
        """
        if len(self.keyframes) == 0:
            return None
        return self._optimise_evenly(self.paging.near(), 1, self.settings.views.global_views)

    def correct(self, correction: PoseCorrection, more: bool = False) -> CorrectionReport:
        """Apply poses and points that the tracker has revised, see `MapCorrector`.

        If Gaussians move, optimisation steps on the keyframes that moved remove the seams.
        """
        settings = self.settings.corrections
        with self.stopwatch.measure("correct"):
            self.optimiser.settle()
            around, moved = self.corrector.correct(correction, settings, more)
        if len(moved):
            seen = np.intersect1d(moved, self.paging.near())
            self._optimise_evenly(seen, self.pace.steps_after_correction(*self.counts), settings.views)
        return CorrectionReport(around, moved=len(moved) > 0)

    def finish(self, progress: Callable[[int, int, float], None] | None = None) -> float | None:
        return finish(self, progress)

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
