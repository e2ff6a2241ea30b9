"""`modp-ti refine OUT`: refines the map of a finished run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modp_ti.commands.shared import AsJson, Quiet, examples, outcome, progress_console

__all__ = ["EXAMPLES", "refine"]

EXAMPLES = examples("modp-ti refine out/room", "modp-ti refine out/street --steps 5000")


def refine(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="output folder of a finished run, whose map is replaced")],
    steps: Annotated[
        int | None, typer.Option(min=1, help="number of steps; empty: refine.steps of the run, or 1000")
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Refine a finished map on all of its keyframes. If it fails or is interrupted, OUT is as it was."""
    with outcome(as_json) as result:
        # Imported here, so that `--help` does not wait for Taichi and the readers to load.
        from modp_ti.engine.refined_run import refine_run

        metrics = refine_run(out, steps, progress_console(quiet))
        result.text = _said(out, metrics)
        result.data = {"output": str(out.absolute()), "metrics": metrics}


def _said(out: Path, metrics: dict) -> str:
    """Return the result in one line."""
    which = "held_out" if metrics["refined"]["held_out"]["count"] else "all"
    before, after = (stage[which]["psnr"] for stage in (metrics["refinement"]["before"], metrics["refined"]))
    scores = ""
    if before is not None and after is not None:
        scores = f"; {which.replace('_', '-')} PSNR {before:.2f} dB before, {after:.2f} dB after"
    return f"written to {out}{scores}"
