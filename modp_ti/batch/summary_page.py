"""Writes the summary page of a batch, with links to the reports of its scenes."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from modp_ti.batch.results import SceneResult, State
from modp_ti.files.atomic import replace_text
from modp_ti.outputs.report import facts

__all__ = ["write_summary_page"]


def write_summary_page(path: Path, results: Sequence[SceneResult], folder: Path | None = None) -> None:
    """Write the page. Raises OSError if it cannot be written.

    Args:
        path: The page.
        results: The results so far.
        folder: The folder that its links are relative to, so that the folders can be moved together; None for its own.
    """
    import jinja2

    packages = ("modp_ti.batch", "modp_ti.outputs.report")
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(package, ".") for package in packages]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    finished = [result for result in results if result.state in (State.finished, State.before)]
    page = environment.get_template("summary_page.html.j2").render(
        results=results,
        finished=finished,
        failed=[result for result in results if result.state is State.failed],
        waiting=[result for result in results if result.state is State.waiting],
        seconds=sum(result.seconds or 0.0 for result in finished),
        frames=sum(result.frames or 0 for result in finished),
        facts=facts,
        links={result.name: _link(folder or path.parent, result) for result in results},
        written=time.strftime("%d %B %Y, %H:%M"),
    )
    replace_text(path, page)


def _link(folder: Path, result: SceneResult) -> str | None:
    """Return the relative URL of a scene's report or else of its output folder; None if it is not finished."""
    if result.output is None or result.psnr is None:
        return None
    output = Path(result.output)
    report = output / "report.html"
    target = report if report.is_file() else output
    return quote(Path(os.path.relpath(target, folder.resolve())).as_posix())
