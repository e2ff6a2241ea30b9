"""The table of a batch on a terminal, and the lines that a log gets instead."""

from __future__ import annotations

import io

from rich.console import Console

from modp_ti.batch.progress_table import ProgressTable
from modp_ti.batch.results import SceneResult, State
from modp_ti.outputs.progress import StageProgress

RESULTS = [
    SceneResult("waits", "waits.yaml", "out/waits", State.waiting),
    SceneResult("runs", "runs.yaml", "out/runs", State.waiting),
    SceneResult("fails", "fails.yaml", None, State.failed, error="[bold]no[/bold] such folder"),
    SceneResult(
        "ends", "ends.yaml", "out/ends", State.finished, scored="held_out", psnr=30.5, frames=9, gaussians=1234
    ),
]


def test_a_terminal_shows_one_table_with_what_runs_first() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=120, color_system=None)
    now = [0.0]
    with ProgressTable(console, lambda: RESULTS, lambda: now[0]) as table:
        table.running("runs", "host", None)
        now[0] = 65.0
        table.running("runs", "host", StageProgress("mapping", 3, 9, "2 keyframes", "  1 min left"))
        table.running("runs", "host", None)  # no news
    shown = console.file.getvalue().split("1 of 4 finished, 1 running, 1 waiting, 1 failed")[-1]  # the last refresh
    rows = [line.split() for line in shown.splitlines() if line.strip()]
    assert [row[0] for row in rows[1:5]] == ["runs", "fails", "waits", "ends"]
    assert "running 1:05  host     mapping 3/9  2 keyframes  1 min left" in shown
    assert "[bold]no[/bold] such folder" in shown
    assert "9 frames, 1,234 Gaussians, held-out PSNR 30.50 dB" in shown


def test_a_log_gets_a_line_for_each_change_and_every_30_seconds() -> None:
    console = Console(file=io.StringIO(), width=80)
    now = [0.0]
    with ProgressTable(console, lambda: RESULTS, lambda: now[0]) as table:
        for second in range(65):
            now[0] = float(second)
            table.running("runs", "host", StageProgress("mapping", second, 100))
            table.tick()
        table.retried("runs", 2, "its machine was lost")
        table.running("runs", "other", None)
        table.ended(RESULTS[2])
        table.ended(RESULTS[3])
    assert console.file.getvalue().splitlines() == [
        "runs: begun on host",
        "runs: mapping 30/100",
        "runs: mapping 60/100",
        "runs: its machine was lost; attempt 2 goes on from its last snapshot",
        "runs: begun on other",
        "fails: failed: [bold]no[/bold] such folder",
        "ends: finished, 9 frames, 1,234 Gaussians, held-out PSNR 30.50 dB",
    ]
