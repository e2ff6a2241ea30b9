"""What is noted of a run: when each frame was done, what it did, and how the map kept its quality."""

from __future__ import annotations

import pytest

from modp_ti.outputs.evaluation import FrameScore
from modp_ti.outputs.report.record import WINDOW, FrameNote, RunRecord, retention
from pipelines.pipeline import FrameReport


def test_frames_are_noted_with_the_time_since_the_first_began() -> None:
    times = iter([1000.0, 1000.5, 1002.0, 1002.25])
    record = RunRecord(clock=lambda: next(times))
    record.begin()
    record.frame(0, FrameReport(0, True, 1, 250, 18.5), 19.5)
    record.frame(1, None)
    record.frame(2, FrameReport(2, False, 1, 260, None, 7), lag=0.25, waiting=2)
    assert record.frames == [
        FrameNote(0, False, True, 0.5, 250, 18.5, 19.5),
        FrameNote(1, True, False, 2.0, 250, None),  # held out: the map is as it was
        FrameNote(2, False, False, 2.25, 260, None, lag=0.25, waiting=2, steps=7),
    ]


def notes(mapped: list[float | None]) -> list[FrameNote]:
    return [FrameNote(i, False, psnr is not None, float(i), 10, psnr, psnr) for i, psnr in enumerate(mapped)]


def scores(psnr: list[float], stage: str = "online") -> list[FrameScore]:
    return [FrameScore(i, f"f{i}", False, stage, value, 0.9, None) for i, value in enumerate(psnr)]


def test_the_change_is_that_of_keyframes_in_every_version() -> None:
    of = retention(notes([20.0, None, 22.0]), scores([21.0, 0.0, 21.0]) + scores([24.0, 0.0, 25.0], "refined"))
    assert of == {"online": {"mean": 0.0, "worst": 0.0}, "refined": {"mean": 3.5, "worst": 3.5}}


def test_the_worst_is_the_mean_of_a_stretch_and_not_of_a_keyframe() -> None:
    count = 3 * WINDOW
    final = [30.0] * count
    for i in range(WINDOW + 5, 2 * WINDOW):  # three quarters of a window lose 2 dB
        final[i] = 28.0
    of = retention(notes([30.0] * count), scores(final))
    assert of is not None
    assert of["online"]["worst"] == pytest.approx(-2.0 * (WINDOW - 5) / WINDOW)
    assert of["online"]["mean"] == pytest.approx(-2.0 * (WINDOW - 5) / count)


def test_without_mapped_keyframes_there_is_none() -> None:
    assert retention(notes([None, None]), scores([20.0, 21.0], "offline")) is None
