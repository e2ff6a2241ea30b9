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
from pipelines.companions.exposure import ExposureZero
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
from pipelines.refinement import finish, optimise_evenly
from pipelines.render.renderer import Renderer
from pipelines.select.gate import FrameGate
from pipelines.select.keyframes import KeyframeSelector
from pipelines.select.views import LocalGlobalViews, ViewSelection
from pipelines.settings import MappingSettings
from pipelines.warm_up import warm_up


@in_engine("compile", "process", "optimise", "optimise_further", "correct", "finish", "prune", "all_gaussians")
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
        companions: What the loop calls at fixed places, in order: exposure, its zero, paging, places, hidden
            Gaussians, masks.

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
        self.settings: MappingSettings = settings
        self.rng = np.random.default_rng(seed)
        self.stopwatch = Stopwatch()
        self.frame_count = self.settled = 0
        self.trajectory = Trajectory()
        levels = settings.levels
        self.keyframes = KeyframeStore(len(levels.probabilities), levels.min_side, self.trajectory)
        with settled(nodes=4 + SparseBricks.NODES) as self.tenancy:
            self.gaussians = GaussianField(settings.sh_degree, settings.max_gaussians)
            self.renderer = Renderer(self.gaussians, max_width, max_height, settings.image_cache)
            self.companions: list[Companion] = []  # filled below: they need the optimiser
            self.optimiser = MapOptimiser(self.gaussians, self.renderer, settings, self.companions)
            self.loss, self.safeguards = self.optimiser.loss, self.optimiser.safeguards
            self.gate = FrameGate(settings.gate, self.trajectory)
            self.selector = KeyframeSelector(settings.keyframes, self.trajectory)
            depth = depth or build_depth(settings.depth, self.renderer, settings.near, self.rng)
            self.densifier = Densifier(settings, self.optimiser, self.keyframes, depth, self.rng, self.stopwatch)
            self.views = views or LocalGlobalViews(settings.views, self.rng)
            self.pace = pace or CompletePace(settings)
            self.budget = self.densifier.budget
            self.paging = Paging(self.gaussians, self.keyframes, self.budget, settings, folder)
            contribution = Contribution(self.gaussians, self.renderer)
            self.hidden = HiddenGaussians(contribution, self.densifier, self.paging, settings.densify.min_contribution)
            self.zero = ExposureZero(self.keyframes, self.gaussians, self.paging)
            self.companions += [
                self.optimiser.exposure,
                self.zero,
                self.paging,
                OtherPlaces(self.densifier),
                self.hidden,
            ]
            if settings.transients:
                self.transients = TransientSweep(self.gaussians, self.keyframes, self.renderer, self.paging)
                self.companions.append(self.transients)
            self.corrector = MapCorrector(self.keyframes, self.densifier, self.paging)

    def process(self, frame: TrackedFrame) -> FrameReport:
        self._refuse_held_out(frame)
        self.frame_count += 1
        self.settled = 0
        self.trajectory.add(frame)
        if self.frame_count % self.settings.densify.prune_every == 0:
            self.prune()
        with self.stopwatch.measure("select"):
            last = next(iter(self.keyframes.before(frame.index, 1)), None)
            if self.gate.refuses(frame, last, self.renderer, self.near):
                return self._report(frame)
            is_wanted = self.selector.is_keyframe(frame, last) and self.pace.takes_keyframe()
            for companion in self.companions:
                companion.before_frame(frame, is_wanted)
            is_keyframe = is_wanted and self.budget.takes_keyframe(frame)
        if is_keyframe:
            return self._add_keyframe(frame, last)
        return self._add_points(frame, is_wanted) if len(self.keyframes) else self._report(frame)

    def _add_keyframe(self, frame: TrackedFrame, last: Keyframe | None) -> FrameReport:
        """Add a keyframe, add Gaussians from it and from the last one of its view, and optimise."""
        view = self._append(frame)
        if len(self.keyframes) > 1 and self.settings.poses.enabled and self.settings.poses.align:
            self.optimiser.poses.align(view)
        with self.stopwatch.measure("optimise"):
            for companion in self.companions:
                companion.new_keyframe(self.keyframes, self.renderer, self.near)
        p = np.array(self.settings.levels.probabilities[: len(view.pyramid)])
        level = int(self.rng.choice(len(p), p=p / p.sum()))
        plan = self.pace.plan(level, *self.counts)
        image = view.at_level(level)
        self.densifier.add_tracked_points(image)
        if self.settings.densify.error_compensation and plan.pixels > 0:
            warming_up = self.frame_count <= self.settings.densify.warm_up
            # What comes into view with a keyframe can be matched once it is seen again, so that half of the pixels are
            # those of the keyframe before.
            before = None if view.index in self.keyframes.begins else last
            self.densifier.add_error_pixels(image, warming_up, plan.pixels if before is None else 0.5 * plan.pixels)
            if before is not None:
                for companion in self.companions:
                    companion.before_views([before])
                self.densifier.add_error_pixels(before.at_level(level), False, 0.5 * plan.pixels)
        psnr = self.optimise(plan.steps, level)
        with self.stopwatch.measure("remove"):
            for companion in self.companions:
                companion.after_keyframe(self.near, plan.swept)
        return self._report(frame, True, psnr, plan.steps)

    def _add_points(self, frame: TrackedFrame, is_wanted: bool) -> FrameReport:
        """Add the tracked points of another frame, at a pose corrected by the neighbouring keyframes.

        Some frames become views: the more directions the map is optimised from, the better it looks from new ones.
        """
        if self.selector.is_between(frame, self.keyframes) and self.budget.takes_between(frame):
            view = self._append(frame, is_between=True)
        else:
            view = self.keyframes.view(frame)
        self.densifier.add_tracked_points(view)
        if not is_wanted:
            return self._report(frame)
        # The budget has no room for this keyframe, so the existing ones are optimised instead. Far from them, every
        # frame is selected as a keyframe; each therefore gets only 1 / max_gap of the steps.
        steps = -(-self.pace.plan(0, *self.counts).steps // self.settings.keyframes.max_gap)
        psnr = optimise_evenly(self, self.paging.near(), steps, self.settings.views.per_step)
        return self._report(frame, False, psnr, steps)

    def _append(self, frame: TrackedFrame, is_between: bool = False) -> Keyframe:
        view = self.keyframes.append(frame, is_between)
        for companion in self.companions:
            companion.after_view(len(self.keyframes) - 1)
        return view

    def _report(
        self, frame: TrackedFrame, is_keyframe: bool = False, psnr: float | None = None, steps: int = 0
    ) -> FrameReport:
        keyframes = len(self.keyframes.selected)
        return FrameReport(frame.index, is_keyframe, keyframes, self.gaussian_count, psnr, steps)

    def optimise(self, steps: int, level: int = 0) -> float | None:
        """Make steps on the last keyframe and the views selected with it, on a pyramid level.

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
                rates = self.optimiser.rates(self.keyframes.scene_depth)
                pose_rate = poses.learning_rate if poses.enabled and step < poses.steps else 0.0
                self.optimiser.step(self.keyframes, views, rates, pose_rate, level)
        with self.stopwatch.measure("optimise"):
            return self.optimiser.settle() if steps > 0 else None

    def optimise_further(self) -> float | None:
        """Make one step on views of the whole map, for time in which no frame waits.

        Returns:
            Mean PSNR of its views; None if there is nothing to optimise yet.
        """
        if len(self.keyframes) == 0:
            return None
        return optimise_evenly(self, self.paging.near(), 1, self.settings.views.global_views)

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
            optimise_evenly(self, seen, self.pace.steps_after_correction(*self.counts), settings.views)
        return CorrectionReport(around, moved=len(moved) > 0)

    def finish(self, progress: Callable[[int, int, float], None] | None = None) -> float | None:
        return finish(self, progress)

    def prune(self) -> int:
        """Remove Gaussians whose opacity is below `densify.prune_opacity`. Returns their number."""
        return self.gaussians.remove(self.gaussians.opacities() >= self.settings.densify.prune_opacity)

    def compile(self) -> None:
        warm_up(self)

    @property
    def counts(self) -> tuple[int, int]:
        """Number of keyframes and of frames so far, as `Pace.plan` takes them."""
        return len(self.keyframes.selected), self.frame_count

    @property
    def gaussian_count(self) -> int:
        return self.paging.count

    def all_gaussians(self) -> dict[str, NDArray]:
        return self.paging.to_numpy()

    @property
    def refused(self) -> Mapping[str, int]:
        return self.gate.refused

    def takes_observations(self, count: int) -> bool:
        return self.budget.takes_observations(count)

    def count_beside(self, nbytes: int) -> None:
        self.budget.beside = nbytes
