"""`modp-ti refine OUT`: refines a finished map region by region, on this machine or on a Ray cluster."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modp_ti.commands.shared import Address, AsJson, Quiet, Where, examples, outcome, progress_console

__all__ = ["EXAMPLES", "refine"]

EXAMPLES = examples(
    "modp-ti refine out/room   (two regions or more, in two rounds)",
    "modp-ti refine out/street --regions 16 --rounds 3 --steps 20000",
    "modp-ti refine out/street --engine ray --address FIRST:6379 --cpus 4",
)
GIGABYTE = 1 << 30


def refine(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="output folder of a finished run, whose map is replaced")],
    regions: Annotated[
        int | None,
        typer.Option(min=1, help="regions of the map, a task each; empty: two, or one for every 200,000 Gaussians"),
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="rounds, after each of which the regions are put together")] = 2,
    steps: Annotated[
        int | None,
        typer.Option(min=1, help="steps of all regions and rounds together; empty: refine.steps of the run, or 1000"),
    ] = None,
    engine: Annotated[
        Where, typer.Option(help="`local`: processes on this machine; `ray`: a Ray cluster (extra `cluster`)")
    ] = Where.local,
    address: Address = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", min=1, help="`local`: regions at a time; empty: as many as the cores allow")
    ] = None,
    cpus: Annotated[
        float | None, typer.Option(min=0.1, help="cores of each region; empty: an equal share, at least one")
    ] = None,
    gpus: Annotated[
        float | None,
        typer.Option(min=0, help="GPUs of each region, 0.5 lets two share one; empty: 1 with `device: cuda`, else 0"),
    ] = None,
    memory: Annotated[
        float | None,
        typer.Option(min=0.1, metavar="GB", help="memory of each region: no machine gets more of them than fit"),
    ] = None,
    attempts: Annotated[
        int, typer.Option(min=1, help="how often a region is begun if its process or its machine is lost")
    ] = 3,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Refine a finished map region by region, side by side. If it fails or is interrupted, OUT is as it was."""
    with outcome(as_json) as result:
        # Imported here, so that `--help` does not wait for Taichi and the readers to load.
        from modp_ti.batch.batch import Shares
        from modp_ti.refining.rounds import Plan, refine_run
        from modp_ti.tasks import open_engine

        shares = Shares(cpus, gpus, None if memory is None else int(memory * GIGABYTE), attempts)
        with open_engine(engine.value, address, jobs) as opened:
            metrics = refine_run(out, Plan(regions, rounds, steps, shares), opened, progress_console(quiet))
        result.text = _said(out, metrics)
        result.data = {"output": str(out.absolute()), "metrics": metrics}


def _said(out: Path, metrics: dict) -> str:
    """Return the result in one line."""
    which = "held_out" if metrics["refined"]["held_out"]["count"] else "all"
    before, after = (stage[which]["psnr"] for stage in (metrics["regions"]["before"], metrics["refined"]))
    scores = ""
    if before is not None and after is not None:
        scores = f"; {which.replace('_', '-')} PSNR {before:.2f} dB before, {after:.2f} dB after"
    return f"written to {out}{scores}"
