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
