"""A realtime run on a small wall, with a clock that the test moves."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.runtime.backend import initialise
from modp_ti.engine.interruption import Interruption, RunStopped
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.realtime import RealtimeRun
from modp_ti.engine.stream import FramesAhead
from modp_ti.inputs.protocol import LiveCounts, Tracker
from modp_ti.inputs.sources import Picture
from pipelines.settings import DensifySettings, MappingSettings, OptimiseSettings
from tests.patience import PATIENCE
from tests.pipelines.wall import frame

SETTINGS = MappingSettings(optimise=OptimiseSettings(steps=3), densify=DensifySettings(pixels=500))

pytestmark = pytest.mark.slow


class Clock:
    """A clock that stands still unless it is moved; each reading takes `tick` seconds."""

    def __init__(self, tick: float = 0.0) -> None:
        self.now, self.tick = 100.0, tick

    def __call__(self) -> float:
        self.now += self.tick
        return self.now


class WallTracker(Tracker):
    """Delivers given events, and says that it has received more."""

    def __init__(self, events: list[TrackedFrame | PoseCorrection], counts: LiveCounts | None = None) -> None:
        self._events, self._counts = events, counts

    @property
    def notes(self) -> list[str]:
        return []

    @property
    def live(self) -> LiveCounts | None:
        return self._counts

    def pictures(self, names: Sequence[str]) -> Iterator[tuple[str, Picture]]:
        return iter(())

    def __iter__(self) -> Iterator[TrackedFrame | PoseCorrection]:
        return iter(self._events)


def never() -> Interruption:
    return Interruption(lambda: None)


def new_mapper(realtime: RealtimeRun) -> Mapper:
    initialise("cpu")  # a process has room for one map
    return Mapper(64, 48, SETTINGS, seed=1, pace=realtime.pace)


def mapped(realtime: RealtimeRun, tracker: Tracker, stop: Interruption | None = None) -> Mapper:
    """Map all that the tracker delivers."""
    mapper = new_mapper(realtime)
    with FramesAhead(tracker, 0) as ahead:
        for event in realtime.events(ahead, mapper, stop or never(), lambda: None):
            if isinstance(event, PoseCorrection):
                realtime.correct(mapper, event)
            else:
                realtime.add(mapper, event)
    return mapper


def test_lag_and_rates_are_those_of_the_frames_times() -> None:
    """Each reading of the clock takes 10 ms; frames have arrived 0.5 s before the mapper begins."""
    clock = Clock()
    frames = [replace(frame(i), arrived=99.5 + 0.1 * i) for i in range(4)]
    tracker = WallTracker(list(frames), LiveCounts(50, 41, 7, 2, 3, newest=104.4))
    realtime = RealtimeRun(SETTINGS, tracker, clock=clock)
    clock.tick = 0.01
    mapped(realtime, tracker)
    live = realtime.metrics()["live"]
    assert {name: live[name] for name in ("arrived", "tracked", "thinned", "lost")} == {
        "arrived": 50,
        "tracked": 41,
        "thinned": 7,
        "lost": 2,
    }
    assert live["rate_arrived"] == pytest.approx(49 / 4.9) and live["rate_tracked"] == pytest.approx(40 / 4.9, abs=0.01)
    assert realtime.waiting == [3, 3, 3, 3], "those that wait in the tracker"
    assert len(realtime.lag) == 4 and 0.5 < realtime.lag[0] < 0.6
    assert live["lag_seconds"]["max"] == pytest.approx(max(realtime.lag), abs=1e-3)
    assert live["seconds_to_map"] is None
    clock.now = 110.0
    realtime.saved()
    assert realtime.metrics()["live"]["seconds_to_map"] == pytest.approx(5.6, abs=0.02)
    status = realtime.status()
    assert status.lag == realtime.lag[-1] and status.waiting == 3


def test_the_lag_is_told_by_minute_of_arrival() -> None:
    clock = Clock()
    frames = [replace(frame(i), arrived=at) for i, at in enumerate((97.0, 98.0, 99.9, 230.0))]
    realtime = RealtimeRun(SETTINGS, tracker := WallTracker(list(frames)), clock=clock)
    clock.now = 240.0
    mapped(realtime, tracker)
    first, second, third = realtime.metrics()["live"]["lag_seconds"]["p95_by_minute"]
    assert first == pytest.approx(np.quantile(realtime.lag[:3], 0.95), abs=1e-3) and second is None
    assert third == pytest.approx(10.0, abs=1e-3)


def test_late_frames_get_no_steps_but_their_points() -> None:
    def late(seconds: float) -> tuple[RealtimeRun, Mapper]:
        tracker = WallTracker([replace(frame(i), arrived=100.0 - seconds) for i in range(5)])
        realtime = RealtimeRun(SETTINGS, tracker, clock=Clock())
        return realtime, mapped(realtime, tracker)

    in_time, mapper = late(0.0)
    assert in_time.pace.skipped == 0 and in_time.steps == [3] * 5
    renders = mapper.pipeline.renderer.view_renders
    too_late, mapper = late(30.0)
    assert too_late.pace.skipped + too_late.pace.merged == 5 and too_late.steps == [0] * 5
    assert mapper.pipeline.renderer.view_renders < 0.3 * renders
    assert len(mapper.pipeline.gaussians) > 100 and len(mapper.frames) == 5


def test_the_map_is_optimised_while_no_frame_waits() -> None:
    """The second frame does not come before the map has got three further steps."""
    enough = threading.Event()

    class Slow(WallTracker):
        def __iter__(self) -> Iterator[TrackedFrame | PoseCorrection]:
            yield frame(0)
            assert enough.wait(timeout=PATIENCE)
            yield frame(1)

    tracker = Slow([])
    realtime = RealtimeRun(SETTINGS, tracker)
    mapper = new_mapper(realtime)
    done: list[int] = []

    def further() -> None:
        done.append(mapper.pipeline.renderer.view_renders)
        if len(done) == 3:
            enough.set()

    with FramesAhead(tracker, 1) as ahead:
        for event in realtime.events(ahead, mapper, never(), further):
            assert isinstance(event, TrackedFrame)
            realtime.add(mapper, event)
    assert realtime.further == len(done) >= 3
    assert np.diff(done[:3]).tolist() == [SETTINGS.views.global_views] * 2
    assert len(mapper.frames) == 2


def test_no_further_step_is_made_while_frames_wait_in_the_tracker() -> None:
    """They are only not read yet: the reading of the second one ends late."""
    frames = [frame(i) for i in range(2)]
    tracker = WallTracker([], LiveCounts(2, 2, 0, 0, 1, newest=100.0))
    realtime = RealtimeRun(SETTINGS, tracker)
    mapper, mapped_first = new_mapper(realtime), threading.Event()

    def read() -> Iterator[TrackedFrame]:
        yield frames[0]
        mapped_first.wait(PATIENCE)
        time.sleep(0.3)  # in which dozens of steps could be made
        yield frames[1]

    with FramesAhead(read(), 2) as ahead:
        for event in realtime.events(ahead, mapper, never(), lambda: None):
            realtime.add(mapper, event)
            mapped_first.set()
            if event.index == 1:
                break
    assert realtime.further == 0


def test_corrections_behind_each_other_move_the_map_once() -> None:
    frames = [frame(i) for i in range(3)]

    def shifted(by: float) -> PoseCorrection:
        T = np.stack([f.T_camera_world for f in frames])
        T[:, 0, 3] += by
        return PoseCorrection(np.arange(3), T)

    tracker = WallTracker([*frames, shifted(0.5), shifted(1.0)])
    realtime = RealtimeRun(SETTINGS, tracker, clock=Clock())
    mapper = new_mapper(realtime)
    with FramesAhead(tracker, 8) as ahead:
        assert ahead._thread is not None
        ahead._thread.join(timeout=PATIENCE)  # all are there
        for event in realtime.events(ahead, mapper, never(), lambda: None):
            if isinstance(event, PoseCorrection):
                realtime.correct(mapper, event)
            else:
                realtime.add(mapper, event)
    assert mapper.frames.corrections == {"received": 2, "moved": 1}
    np.testing.assert_allclose(mapper.pipeline.trajectory[1], shifted(1.0).T_camera_world[1])


def test_the_run_stops_between_two_further_steps() -> None:
    ever = threading.Event()

    class Stalled(WallTracker):
        def __iter__(self) -> Iterator[TrackedFrame | PoseCorrection]:
            yield frame(0)
            ever.wait(timeout=PATIENCE)

    tracker, stop = Stalled([]), never()
    realtime = RealtimeRun(SETTINGS, tracker)
    mapper = new_mapper(realtime)

    def ask() -> None:
        stop.asked = True

    with FramesAhead(tracker, 1) as ahead:
        with pytest.raises(RunStopped):
            for event in realtime.events(ahead, mapper, stop, ask):
                assert isinstance(event, TrackedFrame)
                realtime.add(mapper, event)
        ever.set()
    assert realtime.further == 1
