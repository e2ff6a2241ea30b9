"""`modp-ti view OUT`: shows a finished map, or a PLY file of splats, in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modp_ti.commands.shared import Device, Quiet, examples, outcome, progress_console

__all__ = ["EXAMPLES", "view"]

EXAMPLES = examples(
    "modp-ti view out/room", "modp-ti view splats.ply", "modp-ti view out/room --port 0 --max-splats 1000000"
)


def view(
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="output folder of a finished run, or a .ply file of splats")
    ],
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="address to listen at; 0.0.0.0 is for all that reach this machine")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="port, or the next one that is free; 0 for any")] = 8080,
    max_splats: Annotated[int, typer.Option(min=100, help="splats that a browser draws, of larger maps")] = 300_000,
    device: Annotated[Device, typer.Option(help="`auto`: CUDA if there is a GPU, otherwise the CPU")] = Device.auto,
    quiet: Quiet = False,
) -> None:
    """Show a finished map, or a .ply file of splats, as a web page, until Ctrl-C."""
    with outcome(as_json=False):
        # Imported here, so that `--help` does not wait for Taichi and the readers to load.
        from modp_ti.config.settings import ViewSettings
        from modp_ti.outputs.playback.finished_run import open_run
        from modp_ti.outputs.playback.splat_file import open_splats
        from modp_ti.outputs.progress import ProgressLine
        from modp_ti.outputs.viewer.finished import FinishedViewer

        run = open_splats(out.expanduser()) if out.expanduser().is_file() else open_run(out)
        settings = ViewSettings(enabled=True, host=host, port=port, max_splats=max_splats)
        with ProgressLine(progress_console(quiet)).working("reading the map"):
            viewer = FinishedViewer(run, settings, device.value)
        typer.echo(f"viewer: {viewer.page.address}\nCtrl-C ends it")
        try:
            viewer.serve()
        except KeyboardInterrupt:
            pass
        finally:
            viewer.close()
