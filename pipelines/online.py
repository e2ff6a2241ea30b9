"""The online mapping loop: track, add, filter, select views, optimise (the paper's overview figure)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.map.keyframe import Keyframe
from fields.runtime.tenancy import in_engine
from pipelines import finished_map, online_state
from pipelines.corrections import CorrectionReport
from pipelines.finished_map import FinishedMap
from pipelines.online_map import OnlineMap
from pipelines.pipeline import FrameReport
from pipelines.refinement import Schedule, refine
from pipelines.select.views import global_probabilities
from pipelines.settings import RefineSettings
from pipelines.state import MapState
from pipelines.warm_up import warm_up

__all__ = ["OnlineMapper"]

# Factor on all rates at the end of `finish`. 0.2 and 0.1 differ by less than 0.1 dB on five recordings; 1 is 0.4 to
# 1.0 dB worse.
LAST_RATE = 0.2
GOLDEN_RATIO = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class LastPart:
    """A part of the passes of `OnlineMapper.finish`.

    Attributes:
        places: Places of its keyframes in the store.
        first: Number of views before it.
        end: Number of views after it.
        before: Number of views in the passes before its own.
    """

    places: NDArray[np.int64]
    first: int
    end: int
    before: int


@in_engine("compile", "process", "optimise", "optimise_further", "correct", "finish", "refine", "go_on_with")
@in_engine("state", "restore")
class OnlineMapper(OnlineMap):
    """Builds a Gaussian map from a stream of `TrackedFrame`s.

    Args:
        settings: Settings of the mapping.
        max_width: Largest image width [px].
        max_height: Largest image height [px].
        seed: Seed of the random generator.
        depth: Depth estimator; None builds the one that `settings.depth` names.
        views: View selection; None for `LocalGlobalViews`.
        pace: How much work a frame gets; None for all of the settings.
        folder: Folder for the parts of the map that go to disk; None for a temporary one.

    Example:
        mapper = modp_ti.OnlineMapper(modp_ti.MappingSettings(), max_width=640, max_height=480, seed=0)
        for frame in frames:  # of class `TrackedFrame`
            report = mapper.process(frame)
    """

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
            if is_wanted:
                self.paging.before_keyframe(frame)
            elif len(self.keyframes):
                self.paging.before_points(frame)
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
                psnr = self._optimise_evenly(self.keyframes.near(), steps, self.settings.views.per_step)
        return FrameReport(frame.index, is_keyframe, len(self.keyframes.selected), self.gaussian_count, psnr, steps)

    def _append(self, frame: TrackedFrame, is_between: bool = False) -> Keyframe:
        """Add a frame to the views of the map."""
        view = self.keyframes.append(frame, is_between)
        self.paging.away.look(len(self.keyframes) - 1)
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
            self.views.begin(self.keyframes)
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
        return self._optimise_evenly(self.keyframes.near(), 1, self.settings.views.global_views)

    def correct(self, correction: PoseCorrection, more: bool = False) -> CorrectionReport:
        """Apply poses and points that the tracker has revised, see `MapCorrector`.

        If Gaussians move, optimisation steps on the keyframes that moved remove the seams.
        """
        settings = self.settings.corrections
        with self.stopwatch.measure("correct"):
            self.optimiser.settle()
            around, moved = self.corrector.correct(correction, settings, more)
        if len(moved):
            seen = np.intersect1d(moved, self.keyframes.near())
            self._optimise_evenly(seen, self.pace.steps_after_correction(*self.counts), settings.views)
        return CorrectionReport(around, moved=len(moved) > 0)

    def finish(self, progress: Callable[[int, int, float], None] | None = None) -> float | None:
        """Finish the map after the last frame: passes over all keyframes, then a final pruning.

        While frames arrive, all rates are constant, and large enough for few steps. Here they decay, so that each
        Gaussian comes to rest. In a pass, every keyframe is a view once; views that follow each other are far apart.
        The pace may end the passes early. After an interruption, `finish` goes on where it was.

        Args:
            progress: Called after every step with (views done, number of Gaussians, mean PSNR of the step's views).

        Returns:
            Mean PSNR of the last step; None if nothing was optimised.
        """
        if self.settled == 0:
            self.paging.plan()
        total = self.pace.last_views(len(self.keyframes)) if self.gaussian_count else 0
        psnr = None
        for part in self._last_parts(total):
            if self.settled < part.end or total == 0:
                psnr = self._settle(part, total, progress)
        return psnr

    def _last_parts(self, total: int) -> list[LastPart]:
        """Divide the views of `finish` into parts. Each pass visits the groups of keyframes in turn."""
        groups, count = self.paging.groups(), len(self.keyframes)
        if len(groups) == 1:
            return [LastPart(groups[0], 0, total, 0)]
        parts, first = [], 0
        for before in range(0, total, max(count, 1)):
            seen = 0
            for places in groups:
                seen += len(places)
                end = before + min(count, total - before) * seen // count
                parts.append(LastPart(places, first, end, before))
                first = end
        return parts

    def _settle(self, part: LastPart, total: int, progress: Callable[[int, int, float], None] | None) -> float | None:
        """Make a part of the passes of `finish`."""
        places = part.places
        if self.settled == part.first:
            self.begin_passes(places)
        views = np.resize(places[np.argsort(places * GOLDEN_RATIO % 1.0)], part.end - part.first)
        count, psnr = self.settings.views.per_step, None
        while self.settled < part.end:
            done = self.settled - part.first
            slower = LAST_RATE ** ((part.before + done * len(self.keyframes) / len(places)) / total)
            rates = self.optimiser.rates(self.keyframes.scene_depth, slower, slower, slower)
            batch = views[done : done + count].tolist()
            with self.stopwatch.measure("optimise"):
                psnr = self.optimiser.step(self.keyframes, batch, rates, pose_rate=0.0)
            self.settled += len(batch)
            if progress is not None:
                progress(self.settled, self.gaussian_count, psnr)
        with self.stopwatch.measure("optimise"):
            psnr = self.optimiser.settle() if psnr is not None else None
        self.prune()
        return psnr

    def refine(
        self,
        settings: RefineSettings,
        progress: Callable[[int, float], None] | None = None,
        done: int = 0,
        schedule: Schedule | None = None,
    ) -> None:
        refine(self, settings, progress, done, schedule)

    def go_on_with(self, finished: FinishedMap) -> None:
        """Put a finished map into this new one, see `pipelines.finished_map`."""
        finished_map.go_on_with(self, finished)

    def state(self) -> MapState:
        return online_state.state_of(self)

    def restore(self, state: MapState, frames: Iterable[TrackedFrame]) -> None:
        online_state.restore(self, state, frames)
