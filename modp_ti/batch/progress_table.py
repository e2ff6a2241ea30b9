"""`ProgressTable`: shows the scenes of a batch as one table, or in plain lines where there is no terminal."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from modp_ti.batch.results import SceneResult, State
from modp_ti.outputs.progress import LOG_EVERY, StageProgress

__all__ = ["ProgressTable"]

# Rows of the table at most: scenes that run or have failed come before the others.
MOST_ROWS = 40
COLOURS = {State.finished: "green", State.before: "green", State.failed: "red"}


@dataclass
class _Shown:
    """A scene that runs: where, since when, and how far it is."""

    machine: str
    since: float
    progress: StageProgress | None = None


class ProgressTable:
    """Shows the progress of a batch. It is a context manager, inside which the table is on the screen.

    Args:
        console: Where it is shown.
        results: Returns the results so far, in the order of the rows.
        clock: Returns the time [s].
    """

    def __init__(
        self,
        console: Console,
        results: Callable[[], Sequence[SceneResult]],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._console = console
        self._results = results
        self._clock = clock
        self._running: dict[str, _Shown] = {}
        self._logged = clock()
        self._live = Live(console=console, get_renderable=self._table, refresh_per_second=2, transient=False)

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

    def running(self, name: str, machine: str, progress: StageProgress | None) -> None:
        """Show that a scene runs, and how far it is if that is known."""
        shown = self._running.get(name)
        if shown is None:
            shown = self._running[name] = _Shown(machine, self._clock())
            self._line(f"{name}: begun on {machine}")
        shown.machine = machine
        shown.progress = progress or shown.progress

    def retried(self, name: str, attempt: int, error: str) -> None:
        """Show that a scene waits again, after its process or machine was lost."""
        self._running.pop(name, None)
        self.note(f"{name}: {error}; attempt {attempt} goes on from its last snapshot")

    def ended(self, result: SceneResult) -> None:
        """Show the end of a scene."""
        self._running.pop(result.name, None)
        if result.state is State.failed:
            self.note(f"{result.name}: failed: {result.error}")
        else:
            self._line(f"{result.name}: {result.state.value}{_figures(result)}")

    def tick(self) -> None:
        """Print how far the scenes are, every 30 seconds where there is no terminal. Call it often."""
        if self._console.is_terminal or self._clock() - self._logged < LOG_EVERY:
            return
        self._logged = self._clock()
        for name, shown in self._running.items():
            if shown.progress is not None:
                self.note(f"{name}: {shown.progress}")

    def _line(self, text: str) -> None:
        """Print what a terminal shows in the table."""
        if not self._console.is_terminal:
            self.note(text)

    def _table(self) -> Table:
        results = self._results()
        counts = {state: sum(result.state is state for result in results) for state in State}
        done = counts[State.finished] + counts[State.before]
        waiting = counts[State.waiting] - len(self._running)
        table = Table(box=None, pad_edge=False, title_justify="left", title_style="bold")
        table.title = (
            f"{done} of {len(results)} finished, {len(self._running)} running, {waiting} waiting, "
            f"{counts[State.failed]} failed"
        )
        for name in ("scene", "state", "machine", "progress"):
            table.add_column(name, no_wrap=True, overflow="ellipsis")
        for result in sorted(results, key=self._rank)[:MOST_ROWS]:
            table.add_row(*self._row(result))
        return table

    def _rank(self, result: SceneResult) -> int:
        order = (State.failed, State.waiting, State.finished, State.before)
        return 0 if result.name in self._running else 1 + order.index(result.state)

    def _row(self, result: SceneResult) -> list[Text]:
        """Return the cells of a scene, as `Text`: names and errors may hold the brackets of markup."""
        shown = self._running.get(result.name)
        if shown is None:
            state, style = result.state.value, COLOURS.get(result.state, "")
            machine, what = result.machine, result.error or _figures(result).removeprefix(", ")
        else:
            minutes, seconds = divmod(int(self._clock() - shown.since), 60)
            state, style = f"running {minutes}:{seconds:02d}", ""
            machine, what = shown.machine, "" if shown.progress is None else str(shown.progress)
        return [Text(result.name), Text(state, style=style), Text(machine), Text(what)]


def _figures(result: SceneResult) -> str:
    if result.psnr is None:
        return ""
    which = (result.scored or "").replace("_", "-")
    return f", {result.frames} frames, {result.gaussians:,} Gaussians, {which} PSNR {result.psnr:.2f} dB"
