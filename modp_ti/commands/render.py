"""`modp-ti render OUT`: renders images, depth or a video of a finished map."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from modp_ti.commands.shared import AsJson, Device, Quiet, examples, outcome, picture_size, progress_console
from modp_ti.files.errors import InputError

__all__ = ["EXAMPLES", "render"]

EXAMPLES = examples(
    "modp-ti render out/room   (the recorded path, out/room/recorded.mp4)",
    "modp-ti render out/room --path orbit --size 1280x720 --fov 70 -o orbit.webm",
    "modp-ti render out/room --show depth -o depth/   (float32 TIFF files)",
    "modp-ti render out/room --path mine.txt -o pictures/   (poses of your own)",
)

# The same names as in modp_ti.outputs.playback.film, whose import would load Taichi.
PATH_NAMES = ("recorded", "smoothed", "orbit")


class Shown(str, Enum):
    """Content of the rendered images."""

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
            help="a video, by its ending .mp4 (H.264) or .webm (VP9, smaller), or else a new folder of pictures; "
            "empty: OUT/PATH-NAME.mp4",
        ),
    ] = None,
    path: Annotated[
        str,
        typer.Option(
            metavar="PATH",
            help="`recorded`, `smoothed`, `orbit`, or a trajectory file in TUM's format",
            autocompletion=lambda incomplete: [name for name in PATH_NAMES if name.startswith(incomplete)],
        ),
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
        float | None,
        typer.Option(min=0, help="of a smoothed path: frames around each that it is averaged with; empty: 5"),
    ] = None,
    fps: Annotated[
        float | None, typer.Option(min=1, max=120, help="frames per second of a video; empty: as recorded, else 30")
    ] = None,
    exposure: Annotated[
        bool, typer.Option("--exposure", help="of the recorded path: each picture as exposed as its frame was")
    ] = False,
    device: Annotated[Device, typer.Option(help="`auto`: CUDA if there is a GPU, otherwise the CPU")] = Device.auto,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Render a finished map along the recorded path, a smoothed one, an orbit, or any path of your own."""
    with outcome(as_json) as result:
        # Imported here, so that `--help` does not wait for Taichi and the readers to load.
        from modp_ti.outputs.playback.film import film, is_video, plan_flight
        from modp_ti.outputs.playback.finished_run import open_run
        from modp_ti.outputs.progress import ProgressLine

        line = ProgressLine(progress_console(quiet))
        with line.working("reading the run"):
            run = open_run(out)
        depth = show is Shown.depth
        target = output or run.folder / f"{Path(path).stem}{'-depth' if depth else ''}.mp4"
        if fps is not None and not is_video(target):
            raise InputError(f"--fps: is for videos, and {target} is a folder of pictures: leave it out")
        flight = plan_flight(
            run, path, picture_size(size) if size is not None else None, fov, frames, fps, smooth, exposure
        )
        film(run, flight, target, depth, device.value, line)
        result.text = f"written to {target}"
        result.data = {"output": str(target.absolute()), "pictures": len(flight.poses)}
