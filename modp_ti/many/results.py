"""Results of a batch: a row for each scene; their tables, the summary page, and the lines on the terminal."""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rich.console import Console
from rich.text import Text

from modp_ti.files.atomic import replace_text, replacing
from modp_ti.outputs.progress import LOG_EVERY
from modp_ti.outputs.report import facts


class State(str, Enum):
    """What became of a scene."""

    finished = "finished"
    before = "finished before"
    """An earlier batch or run had finished it, with the same settings."""
    failed = "failed"
    waiting = "waiting"
    """It has not ended yet, or was interrupted; the same command resumes it."""

    @property
    def is_done(self) -> bool:
        """Whether the scene is mapped."""
        return self in (State.finished, State.before)


# Type of each column, in order.
COLUMNS: dict[str, type] = {
    **dict.fromkeys(("name", "scene", "output", "state"), str),
    "attempts": int,
    **dict.fromkeys(("machine", "error"), str),
    **dict.fromkeys(("frames", "keyframes", "gaussians"), int),
    "scored": str,
    **dict.fromkeys(("psnr", "ssim", "lpips", "detail", "ate_rmse"), float),
    **dict.fromkeys(("seconds", "frames_per_second", "peak_memory_mb"), float),
    "resumed": int,
}


@dataclass(frozen=True)
class SceneResult:
    """A row of the tables.

    Attributes:
        name: Name of the scene in the batch.
        scene: What the user named.
        output: Its output folder, None if its settings cannot be read.
        state: What became of it.
        attempts: How often it was begun in this batch.
        machine: Where the last attempt ran, "" if it is not known.
        error: One line that says why it failed, otherwise "".
        figures: The other columns, see `figures`; empty if it is not finished.
    """

    name: str
    scene: str
    output: str | None
    state: State
    attempts: int = 0
    machine: str = ""
    error: str = ""
    figures: Mapping[str, Any] = field(default_factory=dict)

    @property
    def row(self) -> dict[str, Any]:
        """The columns as plain values, None where a figure is not known."""
        values = vars(self) | {"state": self.state.value} | dict(self.figures)
        return {name: values.get(name) for name in COLUMNS}


def figures(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of a finished scene from the content of its `metrics.json`.

    Scores are the means over the held-out frames of the final map, or over all frames (`scored`).
    """
    stage = metrics[facts.last_stage(metrics)]
    scored = "held_out" if stage["held_out"]["count"] else "all"
    of_run = ("frames", "keyframes", "gaussians", "frames_per_second", "peak_memory_mb", "ate_rmse")
    return {
        **{name: metrics.get(name) for name in of_run},
        "scored": scored,
        **{name: stage[scored].get(name) for name in ("psnr", "ssim", "lpips", "detail")},
        "seconds": metrics["seconds"]["total"],
        "resumed": metrics["snapshots"]["resumed"],
    }


def write_csv(path: Path, results: Sequence[SceneResult]) -> None:
    """Write the table with a header line; unknown values are empty. Raises OSError if it cannot be written."""
    with replacing(path, "w") as file:
        writer = csv.DictWriter(file, list(COLUMNS), lineterminator="\n")
        writer.writeheader()
        writer.writerows(result.row for result in results)


def write_parquet(path: Path, results: Sequence[SceneResult]) -> bool:
    """Write the table as a Parquet file, and return False if pyarrow is not installed. Raises OSError as `write_csv`.

    The types of the columns do not depend on the values.
    """
    try:
        import pyarrow  # pyright: ignore[reportMissingImports] - not a dependency
        import pyarrow.parquet  # pyright: ignore[reportMissingImports]
    except ImportError:
        return False
    types = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64()}
    schema = pyarrow.schema([(name, types[kind]) for name, kind in COLUMNS.items()])
    table = pyarrow.Table.from_pylist([result.row for result in results], schema=schema)
    with replacing(path) as file:
        pyarrow.parquet.write_table(table, file)
    return True


def write_summary_page(path: Path, results: Sequence[SceneResult], folder: Path | None = None) -> None:
    """Write the summary page, with links to the reports of the scenes. Raises OSError if it cannot be written.

    Args:
        path: The page.
        results: The results so far.
        folder: The folder that its links are relative to, so that the folders can be moved together; None for its own.
    """
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(
            [jinja2.PackageLoader(package, ".") for package in ("modp_ti.many", "modp_ti.outputs.report")]
        ),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    rows: list[dict[str, Any]] = [result.row | {"link": _link(folder or path.parent, result)} for result in results]
    page = environment.get_template("summary_page.html.j2").render(
        rows=rows,
        finished=sum(result.state.is_done for result in results),
        failed=[result for result in results if result.state is State.failed],
        waiting=sum(result.state is State.waiting for result in results),
        seconds=sum(row["seconds"] or 0.0 for row in rows),
        frames=sum(row["frames"] or 0 for row in rows),
        facts=facts,
        written=time.strftime("%d %B %Y, %H:%M"),
    )
    replace_text(path, page)


def _link(folder: Path, result: SceneResult) -> str | None:
    """Return the relative URL of a scene's report or else of its output folder; None if it is not finished."""
    if result.output is None or not result.state.is_done:
        return None
    output = Path(result.output)
    report = output / "report.html"
    target = report if report.is_file() else output
    return quote(Path(os.path.relpath(target, folder.resolve())).as_posix())


# ---- on the terminal ------------------------------------------------------------------------------------------------


class BatchProgress:
    """Shows the progress of a batch: a line for each begin and end of a scene, and how far those are that run.

    On a terminal, the latter is one line that changes. It is shown inside this object as a context manager.

    Args:
        console: Where it is shown.
        scenes: Number of the scenes.
    """

    def __init__(self, console: Console, scenes: int) -> None:
        self._console = console
        self._scenes = scenes
        self._done = 0
        self._running: dict[str, str] = {}  # how far each scene is
        self._logged = time.monotonic()
        self._status = console.status("")

    def __enter__(self) -> BatchProgress:
        self._status.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._status.stop()

    def note(self, text: str) -> None:
        """Print a note for the user."""
        self._console.print(text, highlight=False, soft_wrap=True, markup=False)

    def running(self, name: str, machine: str, progress: str) -> None:
        """Show that a scene runs, and how far it is if that is known."""
        if name not in self._running:
            self.note(f"{name}: begun on {machine}")
        self._running[name] = progress or self._running.get(name, "")

    def retried(self, name: str, attempt: int, error: str) -> None:
        """Show that a scene waits again, after its process or machine was lost."""
        self._running.pop(name, None)
        self.note(f"{name}: {error}; attempt {attempt} resumes its last snapshot")

    def ended(self, result: SceneResult) -> None:
        """Show the end of a scene."""
        self._running.pop(result.name, None)
        self._done += result.state.is_done
        row = result.row
        which, figures = (row["scored"] or "").replace("_", "-"), ""
        if row["psnr"] is not None:
            figures = f", {row['frames']} frames, {row['gaussians']:,} Gaussians, {which} PSNR {row['psnr']:.2f} dB"
        self.note(f"{result.name}: {result.state.value}{figures}{result.error and ': '}{result.error}")

    def tick(self) -> None:
        """Show how far the scenes are, every 30 seconds where there is no terminal. Call it often."""
        far = [f"{name}: {progress}" for name, progress in self._running.items() if progress]
        running = f"{self._done} of {self._scenes} scenes finished, {len(self._running)} running"
        self._status.update(Text("; ".join([running, *far])))
        if not self._console.is_terminal and time.monotonic() - self._logged >= LOG_EVERY:
            self._logged = time.monotonic()
            for line in far:
                self.note(line)
