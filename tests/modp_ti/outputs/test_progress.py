from __future__ import annotations

import io

import pytest
from rich.console import Console

from modp_ti.outputs import progress
from modp_ti.outputs.progress import LiveStatus, ProgressLine, StageProgress
from pipelines.pipeline import FrameReport


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


def test_a_log_has_a_line_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LOG_EVERY", 0.0)
    text = written(terminal=False)
    for line in (
        "mapping 1/3  1 keyframes  1,200 Gaussians  20.50 dB",
        "mapping 3/3  2 keyframes",
        "refining 1/2  25.25",
    ):
        assert text.count(line) == 1


def test_what_is_quick_leaves_only_its_end_in_a_log() -> None:
    text = written(terminal=False)
    assert "3/3" in text and "1/3" not in text


def test_a_terminal_has_one_line_that_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LOG_EVERY", 0.0)
    assert "mapping 1/3" not in written(terminal=True)


def test_the_time_left_includes_that_of_later_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    """30 of 90 frames at 2 s each are done: 2 minutes for the others, and 3 minutes for what follows."""
    now = [0.0]
    monkeypatch.setattr(progress, "LOG_EVERY", 0.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    console = Console(file=io.StringIO(), width=100)
    line = ProgressLine(console)
    line.start("mapping", 90, later=lambda _: 180.0)
    for index in range(30):
        now[0] += 2.0
        line.frame(FrameReport(index, True, index + 1, 1200, 20.5))
    line.stop()
    text = console.file.getvalue()
    assert "mapping 30/90" in text and text.split("mapping 30/90")[1].splitlines()[0].endswith("5 min left")
    assert "left" not in text.split("mapping 5/90")[0], "no estimate in the first ten seconds"


def log_of(monkeypatch: pytest.MonkeyPatch, totals: list[int], later: float | None) -> str:
    """The log of frames of 2 s each, after each of which that many frames are expected."""
    now = [0.0]
    monkeypatch.setattr(progress, "LOG_EVERY", 0.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    console = Console(file=io.StringIO(), width=100)
    line = ProgressLine(console)
    line.start("mapping", totals[0], later=lambda _: later)
    for index, frames in enumerate(totals):
        now[0] += 2.0
        line.frame(FrameReport(index, True, index + 1, 1200, 20.5), frames)
    line.stop()
    return console.file.getvalue()


def test_frames_that_the_tracker_skips_are_no_longer_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    log = log_of(monkeypatch, [100] * 20 + [60] * 10, later=0.0)
    for place, left in (("mapping 20/100", "3 min left"), ("mapping 30/60", "1 min left")):
        assert log.split(place)[1].splitlines()[0].endswith(left)


def test_no_time_is_shown_while_that_of_later_stages_is_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "left" not in log_of(monkeypatch, [100] * 20, later=None)


def test_what_follows_may_be_told_from_the_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps of 3 s, and afterwards as much work as 20 of them."""
    now = [0.0]
    monkeypatch.setattr(progress, "LOG_EVERY", 0.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    console = Console(file=io.StringIO(), width=100)
    line = ProgressLine(console)
    line.start("refining", 40, later=lambda step: 20 * step)
    for step in range(1, 21):
        now[0] += 3.0
        line.step(step, 25.0)
    line.stop()
    assert console.file.getvalue().split("refining 20/40")[1].splitlines()[0].endswith("2 min left")


def test_a_realtime_run_shows_how_it_keeps_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LOG_EVERY", 0.0)
    console = Console(file=io.StringIO(), width=200)
    line = ProgressLine(console)
    line.start("mapping", None)
    line.frame(FrameReport(0, True, 1, 1200, 20.5, 4), None, LiveStatus(10.0, 9.5, 0.42, 3, 4.25))
    line.stop()
    assert "lag 0.4 s, 3 waiting, camera 10.0/s, tracked 9.5/s, 4.2 steps a keyframe" in console.file.getvalue()


def test_who_watches_is_told_every_change_of_a_stage() -> None:
    told: list[StageProgress] = []
    line = ProgressLine(Console(quiet=True), told.append)
    with line.working("compiling"):
        pass
    line.start("mapping", 2)
    line.frame(FrameReport(0, True, 1, 1200, 20.5))
    line.frame(None, 3)
    line.stop()
    assert told[0] == StageProgress("compiling") and str(told[0]) == "compiling"
    assert [(one.what, one.done, one.total) for one in told[1:]] == [
        ("mapping", 0, 2),
        ("mapping", 1, 2),
        ("mapping", 2, 3),
    ]
    assert "1,200 Gaussians  20.50 dB" in told[2].state and str(told[1]) == "mapping 0/2"


@pytest.mark.parametrize(
    ("count", "said"), [(2, "; held-out PSNR 25.00 dB, SSIM 0.900, LPIPS 0.100\n"), (0, ", 1.50 frames/s\n")]
)
def test_a_run_without_scores_ends_in_a_line_without_them(count: int, said: str) -> None:
    scores = dict(zip(("psnr", "ssim", "lpips"), (25.0, 0.9, 0.1) if count else (None, None, None), strict=True))
    stage = {"held_out": scores | {"count": count}, "all": scores | {"count": count}}
    metrics = {"frames": 3, "keyframes": 2, "gaussians": 1200, "frames_per_second": 1.5, "refined": None}
    console = Console(file=io.StringIO(), width=200)
    ProgressLine(console).summary(metrics | {"online": stage, "offline": None})
    assert console.file.getvalue().startswith("3 frames, 2 keyframes, 1,200 Gaussians, 1.50 frames/s")
    assert console.file.getvalue().endswith(said)
