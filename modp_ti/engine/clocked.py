"""Runs that follow a clock: `ClockedRun` tells its pace what the work costs; `TimedRun` ends at a given time."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.recording import FILE, SessionRecorder
from modp_ti.engine.stream import Conductor
from pipelines.companions.pace import LearningPace
from pipelines.companions.timed_pace import TimedPace
from pipelines.pipeline import FrameReport
from pipelines.refinement import Schedule, in_seconds, in_steps
from pipelines.settings import RefineSettings

# Time to write the map: of every run, and for each frame with its tracked points [s].
WRITING, WRITING_FRAME = 1.0, 0.005


class ClockedRun(Conductor):
    """A run that tells its pace what the work costs, and may be recorded.

    Args:
        pace: Pace of the mapper.
        recorder: Records the session, None for no recording.
        clock: Returns the time [s].
    """

    def __init__(
        self,
        pace: LearningPace,
        recorder: SessionRecorder | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(pace)
        self._learner = pace
        self._recorder = recorder
        self._clock = clock
        self._saved: float | None = None

    def add(self, mapper: Mapper, frame: TrackedFrame) -> FrameReport | None:
        """Map a frame by the pace, and learn what it cost."""
        if self._recorder is not None:
            self._recorder.add_frame(frame)
        began = self._clock()
        before = dict(mapper.pipeline.stopwatch.seconds)
        report = mapper.take(frame)
        after = mapper.pipeline.stopwatch.seconds
        seconds = self._clock() - began
        depth, optimise = (after.get(stage, 0.0) - before.get(stage, 0.0) for stage in ("depth", "optimise"))
        self._learner.end_frame(seconds, depth, optimise, 0 if report is None else report.steps)
        return report

    def correct(self, mapper: Mapper, correction: PoseCorrection) -> None:
        self._correct(mapper, correction, more=False)

    def _correct(self, mapper: Mapper, correction: PoseCorrection, more: bool) -> None:
        if self._recorder is not None:
            self._recorder.add_correction(correction, more)
        mapper.correct(correction, more)

    def schedule(self, settings: RefineSettings) -> Schedule | None:
        schedule = self._schedule(settings)
        return schedule if schedule is None or self._recorder is None else self._recorder.recorded(schedule)

    def _schedule(self, settings: RefineSettings) -> Schedule | None:
        return super().schedule(settings)

    def write_session(self, folder: Path, config: SceneConfig) -> None:
        """Write the recorded session to a folder, if it was recorded."""
        if self._recorder is not None:
            self._recorder.write(folder / FILE, self._learner.decisions, self._about(config))

    def _about(self, config: SceneConfig) -> dict[str, Any]:
        """Return the settings and the measured times of the session."""
        costs = {kind: round(seconds, 5) for kind, seconds in self._learner.costs.known().items()}
        return {"settings": config.model_dump(mode="json"), "costs": costs}

    def saved(self) -> list[str]:
        self._saved = self._clock()
        return [] if self._recorder is None or self._recorder.problem is None else [self._recorder.problem]


class TimedRun(ClockedRun):
    """Finishes the map in a given time: `SceneConfig.minutes`.

    Args:
        config: The scene's settings.
        frames: Number of frames, without the held-out ones; None if unknown.
        recorder: Records the session, None for no recording.
        clock: Returns the time that the run has taken so far [s].
    """

    def __init__(
        self, config: SceneConfig, frames: int | None, recorder: SessionRecorder | None, clock: Callable[[], float]
    ) -> None:
        assert config.minutes is not None
        super().__init__(TimedPace(config.mapping, frames, self._until_writing, config.refine.wanted), recorder, clock)
        self._seconds = 60.0 * config.minutes
        self._writing = WRITING

    def add(self, mapper: Mapper, frame: TrackedFrame) -> FrameReport | None:
        self._writing = WRITING + WRITING_FRAME * len(mapper.frames)
        return super().add(mapper, frame)

    def left(self) -> float | None:
        return None if self._saved is not None else self._seconds - self._clock()

    def _until_writing(self) -> float:
        return self._seconds - self._clock() - self._writing

    def _schedule(self, settings: RefineSettings) -> Schedule:
        seconds = self._until_writing()
        return in_seconds(seconds, self._clock) if seconds > 0.0 else in_steps(0)

    def metrics(self) -> dict[str, Any]:
        """Return the entry `timed` of `metrics.json`."""
        steps = [plan.steps for plan in self._learner.decisions if plan is not None]
        return {
            "timed": {
                "seconds": self._seconds,
                "seconds_to_map": None if self._saved is None else round(self._saved, 3),
                "steps_per_keyframe": round(sum(steps) / len(steps), 2) if steps else 0.0,
            }
        }
