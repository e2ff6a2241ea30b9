"""What is noted of a run: when each frame was done, and what it did."""

from __future__ import annotations

from modp_ti.outputs.report.record import FrameNote, RunRecord
from pipelines.pipeline import FrameReport


def test_frames_are_noted_with_the_time_since_the_first_began() -> None:
    times = iter([1000.0, 1000.5, 1002.0, 1002.25])
    record = RunRecord(clock=lambda: next(times))
    record.begin()
    record.frame(0, FrameReport(0, True, 1, 250, 18.5), 19.5)
    record.frame(1, None)
    record.frame(2, FrameReport(2, False, 1, 260, None))
    assert record.frames == [
        FrameNote(0, False, True, 0.5, 250, 18.5, 19.5),
        FrameNote(1, True, False, 2.0, 250, None),  # held out: the map is as it was
        FrameNote(2, False, False, 2.25, 260, None),
    ]


def test_a_realtime_run_notes_lag_waiting_frames_and_steps() -> None:
    times = iter([0.0, 1.0, 2.0])
    record = RunRecord(clock=lambda: next(times))
    record.begin()
    record.frame(0, FrameReport(0, True, 1, 250, 18.5, 7), lag=0.25, waiting=2)
    record.frame(1, None, lag=0.125, waiting=1)
    assert record.frames == [
        FrameNote(0, False, True, 1.0, 250, 18.5, lag=0.25, waiting=2, steps=7),
        FrameNote(1, True, False, 2.0, 250, None, lag=0.125, waiting=1),
    ]
