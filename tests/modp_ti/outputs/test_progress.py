from __future__ import annotations

import io

import pytest
from rich.console import Console

from modp_ti.outputs import progress
from modp_ti.outputs.progress import ProgressLine
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
