"""`RealtimeRun`: the clock of a realtime run, between the arriving frames, the pace and the mapper.

`open_conductor` chooses between it, a run that ends at a given time, the repetition of a recorded session, and a run
that knows no clock.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.clocked import ClockedRun, TimedRun
from modp_ti.engine.interruption import Interruption
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.recording import RecordedSession, ReplayedRun, SessionRecorder
from modp_ti.engine.stream import Conductor, FramesAhead
from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Event, LiveCounts, Tracker
from modp_ti.inputs.replay import ALL_HELD_OUT
from modp_ti.outputs.progress import LiveStatus
from pipelines.companions.pace import CompletePace, RealtimePace
from pipelines.pipeline import FrameReport
from pipelines.settings import MappingSettings

# Time over which the shown rates are taken [s], and number of keyframes over which the shown steps are.
RECENT, KEYFRAMES = 5.0, 10


def open_conductor(config: SceneConfig, tracker: Tracker, held: ExitStack, clock: Callable[[], float]) -> Conductor:
    """Return the conductor of a run: one that repeats a recorded session, follows a clock, or knows none.

    Args:
        config: The scene's settings.
        tracker: The tracker, or a recorded session.
        held: Closes the recording when the run ends.
        clock: Returns the time that the run has taken so far [s].

    Raises:
        InputError: If the session cannot be recorded, or all frames are held out.
    """
    if isinstance(tracker, RecordedSession):
        return ReplayedRun(config.mapping, tracker)
    recorder = None
    if config.export.session and (config.is_realtime or config.minutes is not None):
        recorder = SessionRecorder()
        held.callback(recorder.close)
    if config.is_realtime:
        return RealtimeRun(config.mapping, tracker, recorder)
    frames, every, views = tracker.frame_count, config.source.holdout, config.source.panorama.count
    held_out = 0 if frames is None or every is None else -(-frames // (every * views)) * views
    if frames and frames == held_out:
        raise InputError(ALL_HELD_OUT)
    mapped = None if frames is None else frames - held_out
    if config.minutes is not None:
        return TimedRun(config, mapped, recorder, clock)
    return Conductor(CompletePace(config.mapping, mapped))


class RealtimeRun(ClockedRun):
    """Keeps the mapper in step with the arriving frames.

    This object reads the clock. It tells the pace when frames arrive and what their work costs, and spends the time in
    which no frame waits on further steps.

    Args:
        settings: Settings of the mapping.
        tracker: The tracker, whose counts are shown and reported.
        recorder: Records the session, None for no recording.
        clock: Returns the time on the clock of `TrackedFrame.arrived` [s].

    Attributes:
        lag: Time from each frame's arrival to the map that holds it [s].
        waiting: Number of frames that waited when each frame's work began.
        steps: Number of optimisation steps of each frame that should have become a keyframe.
        further: Number of steps while no frame was waiting.
    """

    def __init__(
        self,
        settings: MappingSettings,
        tracker: Tracker,
        recorder: SessionRecorder | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.pace: RealtimePace = RealtimePace(settings)
        super().__init__(self.pace, recorder, clock)
        self.lag: list[float] = []
        self.waiting: list[int] = []
        self.steps: list[int] = []
        self.further = 0
        self._tracker = tracker
        self._ahead: FramesAhead[Event]
        self._done: float | None = None  # end of the previous event's work
        self._arrived: list[float] = []  # arrival of each frame
        self._recent: deque[tuple[float, int, int]] = deque()  # newest arrival, frames arrived, frames tracked

    def events(
        self, ahead: FramesAhead[Event], mapper: Mapper, stop: Interruption, further: Callable[[], None]
    ) -> Iterator[Event]:
        """Yield frames and corrections as they arrive, and optimise the map further while none waits.

        Args:
            ahead: The frames and corrections.
            mapper: The mapper that they are for.
            stop: Ends the iteration after Ctrl-C.
            further: Called after each further step.
        """
        self._ahead = ahead
        watch = mapper.pipeline.stopwatch
        while True:
            self._count_aside()
            while not (ahead.ready() or self._waiting()):  # what waits in the tracker comes soon
                stop.check()
                if not self._step_further(mapper):
                    break  # there is no map yet
                further()
            with watch.measure("read"), stop.waiting():
                event = next(ahead, None)
            if event is None:
                return
            self._done = self._clock()
            yield event

    def _count_aside(self) -> None:
        """Count the time since the last frame was mapped, such as the viewer's, for the pace."""
        if self._done is not None:
            self.pace.spend_aside(self._clock() - self._done)

    def _step_further(self, mapper: Mapper) -> bool:
        """Optimise the map by a step; return whether there was something to optimise."""
        began = self._clock()
        if mapper.online.optimise_further() is None:
            return False
        self.further += 1
        if self._recorder is not None:
            self._recorder.add_further_step()
        self.pace.spend_idle(self._clock() - began)
        return True

    def add(self, mapper: Mapper, frame: TrackedFrame) -> FrameReport | None:
        began = self._clock()
        arrived = began if frame.arrived is None else frame.arrived
        self._arrived.append(arrived)
        self.waiting.append(self._waiting())
        decisions = len(self.pace.decisions)
        self.pace.begin_frame(arrived, began)
        report = super().add(mapper, frame)
        self._done = self._clock()
        self.lag.append(self._done - arrived)
        if len(self.pace.decisions) > decisions:
            self.steps.append(0 if report is None else report.steps)
        return report

    def correct(self, mapper: Mapper, correction: PoseCorrection) -> None:
        """Apply a correction, and count its time. If another one waits behind it, the Gaussians move with that one."""
        self._correct(mapper, correction, isinstance(self._ahead.peek(), PoseCorrection))
        self._count_aside()
        self._done = self._clock()

    def _about(self, config: SceneConfig) -> dict[str, Any]:
        return {**super()._about(config), "lag": self.lag}

    def status(self) -> LiveStatus:
        """Return the recent figures."""
        counts = self._counts()
        self._recent.append((counts.newest, counts.arrived, counts.tracked))
        while len(self._recent) > 2 and self._recent[1][0] < counts.newest - RECENT:
            self._recent.popleft()
        since, arrived, tracked = self._recent[0]
        seconds = max(counts.newest - since, 1e-9)
        camera, rate = ((now - then) / seconds for now, then in ((counts.arrived, arrived), (counts.tracked, tracked)))
        steps = self.steps[-KEYFRAMES:]
        return LiveStatus(
            camera if len(self._recent) > 1 else 0.0,
            rate if len(self._recent) > 1 else 0.0,
            self.lag[-1],
            self._waiting(),
            float(np.mean(steps)) if steps else 0.0,
        )

    def note(self) -> dict[str, Any]:
        return {"lag": self.lag[-1], "waiting": self.waiting[-1]}

    def metrics(self) -> dict[str, Any]:
        """Return the entry `live` of `metrics.json`."""
        counts = self._counts()
        seconds = max(counts.newest - self._arrived[0], 1e-9)
        lag = np.array(self.lag)
        minute = ((np.array(self._arrived) - self._arrived[0]) // 60.0).astype(int)
        of_minutes = [lag[minute == m] for m in range(int(minute.max()) + 1)]
        live = {
            "arrived": counts.arrived,
            "tracked": counts.tracked,
            "thinned": counts.thinned,
            "lost": counts.lost,
            "keyframes_merged": self.pace.merged,
            "keyframes_skipped": self.pace.skipped,
            "steps_per_keyframe": round(float(np.mean(self.steps)), 2) if self.steps else 0.0,
            "further_steps": self.further,
            "lag_seconds": {
                "median": round(float(np.median(lag)), 3),
                "p95": round(float(np.quantile(lag, 0.95)), 3),
                "max": round(float(lag.max()), 3),
                "p95_by_minute": [round(float(np.quantile(of, 0.95)), 3) if len(of) else None for of in of_minutes],
            },
            "seconds_to_map": None if self._saved is None else round(self._saved - counts.newest, 3),
            "rate_arrived": round((counts.arrived - 1) / seconds, 2),
            "rate_tracked": round((counts.tracked - 1) / seconds, 2),
        }
        return {"live": live}

    def _waiting(self) -> int:
        live = self._tracker.live
        return self._ahead.waiting + (0 if live is None else live.waiting)

    def _counts(self) -> LiveCounts:
        """Return the tracker's counts; for a tracker that follows no clock, those of the frames that it delivered."""
        live = self._tracker.live
        if live is not None:
            return live
        return LiveCounts(len(self.lag), len(self.lag), 0, 0, 0, self._arrived[-1] if self._arrived else 0.0)
