"""`modp-ti batch SCENES...`: maps many recordings, on this machine or on a Ray cluster."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modp_ti.commands.shared import (
    Address,
    AsJson,
    Best,
    Fast,
    Overrides,
    Quiet,
    Where,
    chosen_preset,
    examples,
    outcome,
    progress_console,
)

EXAMPLES = examples(
    "modp-ti batch */scene.yaml   (again: resumes what is not finished)",
    "modp-ti batch videos/*.mp4 --fast --jobs 2   (to out/NAME, as modp-ti run)",
    "modp-ti batch */scene.yaml --set refine.steps=3000 -o out/careful",
    "modp-ti batch */scene.yaml --engine ray --cpus 4 --memory 4",
    "modp-ti batch */scene.yaml --engine ray --gpus 1 --store s3://bucket/maps",
    "modp-ti batch */scene.yaml --quiet --json > result.json",
)
UNFINISHED = 1
GIGABYTE = 1 << 30


def batch(
    scenes: Annotated[
        list[Path], typer.Argument(metavar="SCENES...", help="scene files (YAML), videos and folders of images")
    ],
    engine: Annotated[
        Where, typer.Option(help="`local`: processes on this machine; `ray`: a Ray cluster (extra `cluster`)")
    ] = "local",
    address: Address = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", min=1, help="`local`: scenes at a time; empty: as many as the cores allow")
    ] = None,
    cpus: Annotated[
        float | None, typer.Option(min=0.1, help="cores of each scene; empty: an equal share, at least one")
    ] = None,
    gpus: Annotated[
        float | None,
        typer.Option(min=0, help="GPUs of each scene, 0.5 lets two share one; empty: 1 with `device: cuda`, else 0"),
    ] = None,
    memory: Annotated[
        float | None,
        typer.Option(min=0.1, metavar="GB", help="memory of each scene: no machine gets more of them than fit"),
    ] = None,
    attempts: Annotated[
        int, typer.Option(min=1, help="how often a scene is begun if its process or its machine is lost")
    ] = 3,
    store: Annotated[
        str | None,
        typer.Option(
            "--store", metavar="URL", help="folder for snapshots and results, where machines share no file system"
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FOLDER", help="folder of the tables and the summary page")
    ] = Path("out/batch"),
    set_: Overrides = None,
    fast: Fast = False,
    best: Best = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Map many recordings, each in a process of its own. Exit code: 0 all are finished, 1 some are not."""
    with outcome(as_json) as result:
        # Imported here, so that `--help` does not wait for the readers to load.
        from modp_ti.files.storage import Storage
        from modp_ti.many.batch import LOGS, PAGE, Shares, read_scenes, run_batch, with_store
        from modp_ti.many.pool import open_pool

        preset = chosen_preset(fast, best)
        if store is not None:
            Storage(store).probe()
        named = read_scenes(scenes, set_ or [], preset)
        if store is not None:
            named = with_store(named, store)
        shares = Shares(cpus, gpus, None if memory is None else int(memory * GIGABYTE), attempts)
        with open_pool(engine, output / LOGS, address, jobs) as pool:
            results = run_batch(named, pool, output, shares, progress_console(quiet))
        done = sum(result.state.is_done for result in results)
        result.code = 0 if done == len(results) else UNFINISHED
        result.text = f"{done} of {len(results)} scenes are finished; the summary is {output / PAGE}"
        result.data = {"output": str(output.absolute()), "scenes": [result.row for result in results]}
