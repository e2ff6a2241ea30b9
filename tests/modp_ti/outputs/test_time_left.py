from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest

from modp_ti.config.settings import SceneConfig
from modp_ti.outputs.progress import FULL_SIZE, RENDERED, SCORED, TimeAfterMapping, TimeLeft, duration
from pipelines.pipeline import Pipeline


class Clock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def after(left: TimeLeft, clock: Clock, costs: list[float], done: int = 0) -> None:
    """Finish an item after each of the given times [s]."""
    for number, cost in enumerate(costs, done + 1):
        clock.now += cost
        left.update(number)


def test_items_that_take_the_same_time_are_estimated_exactly() -> None:
    clock = Clock()
    left = TimeLeft(100, clock=clock)
    after(left, clock, [0.5] * 40)
    assert left.seconds() == pytest.approx(30.0)


def test_the_pace_is_that_of_the_last_third() -> None:
    """Items that become slower: the overall mean would promise 60 x 1 s where each takes 2 s."""
    clock = Clock()
    left = TimeLeft(100, clock=clock)
    after(left, clock, [0.5] * 20 + [1.0] * 10 + [2.0] * 10)
    assert left.seconds() == pytest.approx(60 * 2.0)


def test_preparations_are_not_extrapolated() -> None:
    clock = Clock()
    left = TimeLeft(1000, clock=clock)
    after(left, clock, [60.0])
    assert left.seconds() is None
    after(left, clock, [0.2] * 60, done=1)
    assert left.seconds() == pytest.approx(0.2 * (1000 - 61))


@pytest.mark.parametrize("before", [0, 3, 100])
@pytest.mark.parametrize("pause", [60.0, 3600.0])
def test_a_pause_is_left_out(pause: float, before: int) -> None:
    """The run is paused, or its process is stopped, after so many items."""
    clock = Clock()
    left = TimeLeft(1000, clock=clock)
    after(left, clock, [0.2] * before)
    after(left, clock, [pause + 0.2], done=before)
    assert left.seconds() is None or left.seconds() == pytest.approx(0.2 * (999 - before), rel=0.05)
    after(left, clock, [0.2] * 60, done=before + 1)
    assert left.seconds() == pytest.approx(0.2 * (939 - before), rel=0.05)


def test_items_that_become_slow_are_no_pause() -> None:
    clock = Clock()
    left = TimeLeft(100, clock=clock)
    after(left, clock, [0.1] * 50 + [20.0] * 10)
    assert left.seconds() == pytest.approx(40 * 20.0, rel=0.3)


def test_a_resumed_run_counts_only_its_own_items() -> None:
    clock = Clock()
    left = TimeLeft(100, done=80, clock=clock)
    after(left, clock, [2.0] * 10, done=80)
    assert left.seconds() == pytest.approx(20.0)


def test_nothing_is_promised_early_or_for_a_stream() -> None:
    clock = Clock()
    left, stream = TimeLeft(100, clock=clock), TimeLeft(None, clock=clock)
    after(left, clock, [3.0] * 3)
    assert left.seconds() is None
    after(stream, clock, [3.0] * 10)
    assert stream.seconds() is None


def test_no_item_for_long_is_no_estimate() -> None:
    clock = Clock()
    left = TimeLeft(100, clock=clock)
    clock.now += 60.0
    assert left.seconds() is None


class MadeUpMap:
    """A map whose clock, views and keyframes a test sets."""

    def __init__(self) -> None:
        self.stopwatch = SimpleNamespace(seconds={})
        self.renderer = SimpleNamespace(view_renders=0)
        self.keyframes: list[int] = []

    def keyframe(self, views: int, seconds: float) -> None:
        """Add a keyframe with as many views of so many seconds each."""
        self.keyframes.append(len(self.keyframes))
        self.renderer.view_renders += views
        self.stopwatch.seconds["optimise"] = self.stopwatch.seconds.get("optimise", 0.0) + views * seconds


def after_mapping(made: MadeUpMap, **settings: object) -> TimeAfterMapping:
    config = SceneConfig.model_validate(
        {"source": {"path": "x"}, "tracker": {"kind": "klt"}, "output": "out", **settings}, strict=False
    )
    return TimeAfterMapping(config, cast(Pipeline, made))


def test_what_follows_the_last_frame_is_estimated_from_the_views_so_far() -> None:
    """Every second frame a keyframe; 100 of 400 frames done: there will be 200 keyframes."""
    made = MadeUpMap()
    later = after_mapping(made, mapping={"optimise": {"last_passes": 3}}, refine={"steps": 200, "views": 4})
    assert later.seconds(0, 400) is None
    for done in range(2, 102, 2):
        made.keyframe(24, 0.01)
        found = later.seconds(done, 400)
    views = 3 * 200 + 200 * 4 + RENDERED * 200 + SCORED * 2 * 400
    assert found == pytest.approx(0.01 * FULL_SIZE * views)


def test_views_that_become_slower_count_as_the_recent_ones() -> None:
    made = MadeUpMap()
    later = after_mapping(
        made,
        mapping={"optimise": {"last_passes": 1}},
        refine={"steps": 100, "views": 1, "min_contribution": 0.0},
    )
    for done, seconds in enumerate([0.01] * 30 + [0.03] * 30, 1):
        made.keyframe(10, seconds)
        found = later.seconds(done, 60)
    assert found == pytest.approx(0.03 * FULL_SIZE * (60 + 100 + SCORED * 2 * 60))


def test_without_refinement_the_scores_remain() -> None:
    made = MadeUpMap()
    later = after_mapping(made, mapping={"optimise": {"last_passes": 0}}, refine={"steps": 0, "min_contribution": 0.5})
    for done in range(1, 21):
        made.keyframe(10, 0.02)
        found = later.seconds(done, 50)
    assert found == pytest.approx(0.02 * FULL_SIZE * SCORED * 50)


def test_of_a_stream_and_of_an_offline_map_nothing_is_promised() -> None:
    made = MadeUpMap()
    online, offline = after_mapping(made), after_mapping(made, mode="offline")
    for done in range(1, 21):
        made.keyframe(10, 0.02)
        assert online.seconds(done, None) is None and offline.seconds(done, 50) is None


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.2, "0 s"), (40.4, "40 s"), (59.6, "1 min"), (150, "2 min"), (3570, "1 h 0 min"), (4800, "1 h 20 min")],
)
def test_durations_are_written_as_a_person_would(seconds: float, text: str) -> None:
    assert duration(seconds) == text
