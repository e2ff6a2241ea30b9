"""`modp-ti render OUT`: pictures, depth or a video of a finished map."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from modp_ti.command_line import Device, in_one_line, picture_size

__all__ = ["render"]


class Shown(str, Enum):
    """What a picture shows."""

    colour = "colour"
    depth = "depth"


def render(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="output folder of a finished run")],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="PATH",
            help="a video, by its ending .mp4 (quick) or .webm (for browsers), or else a new folder of pictures; "
            "empty: OUT/PATH-NAME.mp4",
        ),
    ] = None,
    path: Annotated[
        str,
        typer.Option(metavar="PATH", help="`recorded`, `smoothed`, `orbit`, or a trajectory file in TUM's format"),
    ] = "recorded",
    show: Annotated[Shown, typer.Option(help="in a folder, depth is float32 TIFF in scene units")] = Shown.colour,
    size: Annotated[str | None, typer.Option(metavar="WIDTHxHEIGHT", help="of the pictures; empty: as mapped")] = None,
    fov: Annotated[
        float | None, typer.Option(min=1, max=150, help="horizontal field of view in degrees; empty: as recorded")
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="pictures of a smoothed path or an orbit; empty: 240 or more")
    ] = None,
    smooth: Annotated[
        float, typer.Option(min=0, help="of a smoothed path: frames around each that it is averaged with (deviation)")
    ] = 5.0,
    fps: Annotated[
        float | None, typer.Option(min=1, max=120, help="frames per second of a video; empty: as recorded, else 30")
    ] = None,
    device: Annotated[Device, typer.Option(help="`auto` takes CUDA where there is a GPU")] = Device.auto,
) -> None:
    """Render a finished map along the recorded path, a smoothed one, an orbit, or any path of your own."""
    with in_one_line():
        # Imported here: asking for help must not wait for the compiler and the readers.
        from rich.console import Console

        from modp_ti.playback.finished_run import open_run
        from modp_ti.playback.flight import film, plan_flight
        from modp_ti.progress import ProgressLine

        run = open_run(out)
        flight = plan_flight(run, path, picture_size(size) if size is not None else None, fov, frames, fps, smooth)
        depth = show is Shown.depth
        target = output or run.folder / f"{Path(path).stem}{'-depth' if depth else ''}.mp4"
        film(run, flight, target, depth, device.value, ProgressLine(Console(stderr=True)))
    typer.echo(f"written to {target}")
