"""What a run says of how far it is: in a log, on a terminal, to a watcher; and the time that is left."""

from __future__ import annotations

import io
from types import SimpleNamespace
from typing import cast

import pytest
from rich.console import Console

from modp_ti.config.settings import SceneConfig
from modp_ti.outputs import progress
from modp_ti.outputs.progress import (
    FULL_SIZE,
    RENDERED,
    SCORED,
    LiveStatus,
    ProgressLine,
    StageProgress,
    TimeAfterMapping,
    TimeLeft,
)
from pipelines.pipeline import FrameReport, Pipeline


def written(terminal: bool) -> str:
    """What a run of three frames and two steps writes."""
    console = Console(file=io.StringIO(), force_terminal=terminal, width=100)
    line = ProgressLine(console)
    line.start("mapping", 3)
    line.frame(FrameReport(0, True, 1, 1200, 20.5))
    line.frame(None)
    line.frame(FrameReport(2, True, 2, 2400, 21.5))
    line.start("refining", 2)
    line.step(1, 25.25)
    line.stop()
    return console.file.getvalue()


def test_a_log_has_a_line_now_and_then_and_a_terminal_one_that_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    quick = written(terminal=False)
    assert "3/3" in quick and "1/3" not in quick
    monkeypatch.setattr(progress, "LOG_EVERY", 0.0)
    text = written(terminal=False)
    for line in ("mapping 1/3  1 keyframes  1,200 Gaussians  20.50 dB", "mapping 3/3", "refining 1/2  25.25"):
        assert text.count(line) == 1
    assert "mapping 1/3" not in written(terminal=True)


@pytest.mark.parametrize(
    ("totals", "later", "place", "left"),
    [
        ([90] * 30, lambda _: 180.0, "mapping 30/90", "5 min left"),  # 2 minutes of frames, and 3 of what follows
        ([100] * 20 + [60] * 10, lambda _: 0.0, "mapping 20/100", "3 min left"),
        ([100] * 20 + [60] * 10, lambda _: 0.0, "mapping 30/60", "1 min left"),  # frames that the tracker skips
        ([60] * 30, lambda frame: 30 * frame, "mapping 30/60", "2 min left"),  # what follows, by the pace
        ([100] * 20, lambda _: None, "mapping 20/100", None),  # that of later stages is unknown
        ([100] * 4, lambda _: 0.0, "mapping 4/100", None),  # no estimate in the first ten seconds
    ],
)
def test_the_time_left_includes_that_of_later_stages(
    monkeypatch: pytest.MonkeyPatch, totals: list[int], later, place: str, left: str | None
) -> None:
    """Frames of 2 s each, after each of which `totals` says how many are expected."""
    now = [0.0]
    monkeypatch.setattr(progress, "LOG_EVERY", 0.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    console = Console(file=io.StringIO(), width=100)
    line = ProgressLine(console)
    line.start("mapping", totals[0], later=later)
    for index, frames in enumerate(totals):
        now[0] += 2.0
        line.frame(FrameReport(index, True, index + 1, 1200, 20.5), frames)
    line.stop()
    said = console.file.getvalue().split(place)[1].splitlines()[0]
    assert said.endswith(left) if left else "left" not in said


def test_who_watches_is_told_every_change_of_a_stage() -> None:
    told: list[StageProgress] = []
    line = ProgressLine(Console(quiet=True), told.append)
    with line.working("compiling"):
        pass
    line.start("mapping", 2)
    line.frame(FrameReport(0, True, 1, 1200, 20.5, 4), None, LiveStatus(10.0, 9.5, 0.42, 3, 4.25))
    line.frame(None, 3)
    line.stop()
    places = [("compiling", 0, None), ("mapping", 0, 2), ("mapping", 1, 2), ("mapping", 2, 3)]
    assert [(one.what, one.done, one.total) for one in told] == places
    assert str(told[0]) == "compiling" and str(told[1]) == "mapping 0/2"
    assert all(part in told[2].state for part in ("1,200 Gaussians  20.50 dB", "lag 0.4 s, 3 waiting"))


def test_a_tracker_that_prepares_shows_it_in_place_of_what_is_gone_through() -> None:
    told: list[StageProgress] = []
    line = ProgressLine(Console(quiet=True), told.append)

    def images():
        for done in (1, 2):
            line.prepare("tracking", done, 2)
        yield from "abc"

    assert "".join(line.through("reading", images(), 3)) == "abc"
    assert str(told[-1]).startswith("reading 3/3") and any(one.what == "tracking" for one in told)


# ---- the time left -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("total", "done", "costs", "left"),
    [
        (100, 0, [0.5] * 40, 30.0),
        (100, 0, [0.5] * 20 + [1.0] * 10 + [2.0] * 10, 60 * 2.0),  # the pace is that of the last third
        (1000, 0, [60.0], None),  # preparations are not extrapolated
        (1000, 0, [60.0] + [0.2] * 60, 0.2 * 939),
        (1000, 0, [0.2] * 100 + [3600.2] + [0.2] * 60, 0.2 * 839),  # the run was paused
        (1000, 0, [0.2] * 3 + [60.2] + [0.2] * 60, 0.2 * 936),
        (100, 0, [0.1] * 50 + [20.0] * 10, 40 * 20.0),  # items that become slow are no pause
        (100, 80, [2.0] * 10, 20.0),  # a resumed run counts only its own items
        (100, 0, [3.0] * 3, None),  # nothing is promised early
        (None, 0, [3.0] * 10, None),  # or for a stream
    ],
)
def test_the_time_left_is_that_of_the_recent_pace(
    total: int | None, done: int, costs: list[float], left: float | None
) -> None:
    now = [100.0]
    estimate = TimeLeft(total, done, clock=lambda: now[0])
    for number, cost in enumerate(costs, done + 1):
        now[0] += cost
        estimate.update(number)
    assert estimate.seconds() == (left if left is None else pytest.approx(left, rel=0.3 if 20.0 in costs else 0.05))


def after_mapping(costs: list[float], frames: int | None, every: int = 1, **settings: object) -> float | None:
    """The estimate after keyframes of ten views that take as long each; every how manyth frame is one."""
    made = SimpleNamespace(
        stopwatch=SimpleNamespace(seconds={"optimise": 0.0}), renderer=SimpleNamespace(view_renders=0), keyframes=[]
    )
    given = {"source": {"path": "x"}, "tracker": {"kind": "klt"}, "output": "out", **settings}
    later = TimeAfterMapping(SceneConfig.model_validate(given, strict=False), cast(Pipeline, made))
    found = later.seconds(0, frames)
    assert found is None
    for number, cost in enumerate(costs, 1):
        made.keyframes.append(number)
        made.renderer.view_renders += 10
        made.stopwatch.seconds["optimise"] += 10 * cost
        found = later.seconds(every * number, frames)
    return found


@pytest.mark.parametrize(
    ("costs", "every", "frames", "last", "refine", "left"),
    [
        # 100 of 400 frames are done, of which every second is a keyframe.
        ([0.01] * 50, 2, 400, 3, {"steps": 200, "views": 4}, 0.01 * (3 * 200 + 800 + RENDERED * 200 + SCORED * 800)),
        ([0.01] * 30 + [0.03] * 30, 1, 60, 1, {"steps": 100, "views": 1, "min_contribution": 0.0}, 0.03 * 160),
        ([0.02] * 20, 1, 50, 0, {"steps": 0, "min_contribution": 0.5}, 0.02 * SCORED * 50),
        ([0.02] * 20, 1, None, 0, {}, None),
    ],
)
def test_what_follows_the_last_frame_is_estimated_from_the_recent_views(
    costs: list[float], every: int, frames: int | None, last: int, refine: dict, left: float | None
) -> None:
    settings = {"mapping": {"optimise": {"last_passes": last}}, "refine": refine}
    if left is not None and len(costs) == 60:
        left += 0.03 * SCORED * 2 * 60
    found = after_mapping(costs, frames, every, **settings)
    assert found == (left if left is None else pytest.approx(left * FULL_SIZE))
    assert after_mapping(costs, frames, every, mode="offline") is None
