"""`ProgressTable`: shows the scenes of a batch as one table, or in plain lines where there is no terminal."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from modp_ti.many.results import SceneResult, State
from modp_ti.outputs.progress import LOG_EVERY

__all__ = ["ProgressTable"]

# Rows of the table at most: scenes that run or have failed come before the others.
MOST_ROWS = 40
COLOURS = {State.finished: "green", State.before: "green", State.failed: "red"}
ORDER = (State.failed, State.waiting, State.finished, State.before)


@dataclass
class _Shown:
    """A scene that runs: where, since when, and how far it is."""

    machine: str
    since: float
    progress: str = ""


class ProgressTable:
    """Shows the progress of a batch. It is a context manager, inside which the table is on the screen.

    Args:
        console: Where it is shown.
        results: Returns the results so far, in the order of the rows.
    """

    def __init__(self, console: Console, results: Callable[[], Sequence[SceneResult]]) -> None:
        self._console = console
        self._results = results
        self._running: dict[str, _Shown] = {}
        self._logged = time.monotonic()
        self._live = Live(console=console, get_renderable=self.table, refresh_per_second=2, transient=False)

    def __enter__(self) -> ProgressTable:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def note(self, text: str) -> None:
        """Print a note for the user."""
        self._console.print(text, highlight=False, soft_wrap=True, markup=False)

    def running(self, name: str, machine: str, progress: str) -> None:
        """Show that a scene runs, and how far it is if that is known."""
        if name not in self._running:
            self._running[name] = _Shown(machine, time.monotonic())
            self._line(f"{name}: begun on {machine}")
        shown = self._running[name]
        shown.machine, shown.progress = machine, progress or shown.progress

    def retried(self, name: str, attempt: int, error: str) -> None:
        """Show that a scene waits again, after its process or machine was lost."""
        self._running.pop(name, None)
        self.note(f"{name}: {error}; attempt {attempt} resumes its last snapshot")

    def ended(self, result: SceneResult) -> None:
        """Show the end of a scene."""
        self._running.pop(result.name, None)
        if result.state is State.failed:
            self.note(f"{result.name}: failed: {result.error}")
        else:
            self._line(f"{result.name}: {result.state.value}{_figures(result)}")

    def tick(self) -> None:
        """Print how far the scenes are, every 30 seconds where there is no terminal. Call it often."""
        if self._console.is_terminal or time.monotonic() - self._logged < LOG_EVERY:
            return
        self._logged = time.monotonic()
        for name, shown in self._running.items():
            if shown.progress:
                self.note(f"{name}: {shown.progress}")

    def table(self) -> Table:
        """Return the table as it is now. Cells are `Text`, as names and errors may hold the brackets of markup."""
        results = self._results()
        counts = {state: sum(result.state is state for result in results) for state in State}
        table = Table(box=None, pad_edge=False, title_justify="left", title_style="bold")
        table.title = (
            f"{sum(result.state.is_done for result in results)} of {len(results)} finished, "
            f"{len(self._running)} running, "
            f"{counts[State.waiting] - len(self._running)} waiting, {counts[State.failed]} failed"
        )
        for name in ("scene", "state", "machine", "progress"):
            table.add_column(name, no_wrap=True, overflow="ellipsis")
        rank = lambda result: 0 if result.name in self._running else 1 + ORDER.index(result.state)  # noqa: E731
        for result in sorted(results, key=rank)[:MOST_ROWS]:
            shown = self._running.get(result.name)
            if shown is None:
                state, style = result.state.value, COLOURS.get(result.state, "")
                machine, what = result.machine, result.error or _figures(result).removeprefix(", ")
            else:
                minutes, seconds = divmod(int(time.monotonic() - shown.since), 60)
                state, style, machine, what = f"running {minutes}:{seconds:02d}", "", shown.machine, shown.progress
            table.add_row(Text(result.name), Text(state, style=style), Text(machine), Text(what))
        return table

    def _line(self, text: str) -> None:
        """Print what a terminal shows in the table."""
        if not self._console.is_terminal:
            self.note(text)


def _figures(result: SceneResult) -> str:
    row = result.row
    if row["psnr"] is None:
        return ""
    which = (row["scored"] or "").replace("_", "-")
    return f", {row['frames']} frames, {row['gaussians']:,} Gaussians, {which} PSNR {row['psnr']:.2f} dB"
