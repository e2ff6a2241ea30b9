"""`modp-ti locate OUT PICTURE ...`: finds where new pictures were taken in a finished map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modp_ti.commands.shared import AsJson, Device, Quiet, examples, one_line, outcome, progress_console
from modp_ti.files.errors import InputError

if TYPE_CHECKING:
    from modp_ti.outputs.locating.locator import Location

__all__ = ["EXAMPLES", "locate"]

EXAMPLES = examples(
    "modp-ti locate out/room new.jpg",
    "modp-ti locate out/room new/*.jpg > found.txt   (for `render --path`)",
    "modp-ti locate out/room phone.jpg --camera fx=3012,k1=0.03",
    "modp-ti locate out/room new.jpg --json",
)

NOT_FOUND = 1


def locate(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="output folder of a finished run")],
    pictures: Annotated[list[Path], typer.Argument(metavar="PICTURE", help="image files")],
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="KEY=VALUE,...",
            help="camera of the pictures, with the keys of `source.intrinsics`, such as fx=525.5,k1=-0.03; empty: the "
            "run's camera if the shape of a picture is that of the run's images, else its focal length is estimated",
        ),
    ] = None,
    device: Annotated[Device, typer.Option(help="`auto`: CUDA if there is a GPU, otherwise the CPU")] = Device.auto,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Find where new pictures were taken in a finished map. Prints a line in TUM format for each, timed 0, 1, 2, ...

    Exit code 1: a picture was not located.
    """
    with outcome(as_json) as result:
        # Imported here, so that `--help` does not wait for Taichi and the readers to load.
        from modp_ti.outputs.formats.trajectory import tum_line
        from modp_ti.outputs.locating.locator import Locator, given_camera
        from modp_ti.outputs.progress import ProgressLine

        console = progress_console(quiet)
        line = ProgressLine(console)
        given = None if camera is None else given_camera(camera)
        for picture in pictures:
            if not picture.is_file():
                raise InputError(
                    f"{picture}: {'is a folder' if picture.is_dir() else 'no such picture'}; name image files"
                )
        locator = Locator(out, device.value, console)
        found = [locator.locate(picture, given) for picture in line.through("locating", pictures, len(pictures))]
        for note in dict.fromkeys(location.note for location in found):
            line.note(f"note: {note}")
        lines = []
        for number, location in enumerate(found):
            if location.T_camera_world is None:
                typer.echo(f"not located: {one_line(location.name)}: {location.reason}", err=True)
                result.code = NOT_FOUND
            else:
                lines.append(tum_line(number, location.T_camera_world))
        result.text = "\n".join(lines)
        result.data = {"pictures": [_as_data(number, location) for number, location in enumerate(found)]}


def _as_data(number: int, location: Location) -> dict[str, Any]:
    """The JSON object of a picture."""
    from dataclasses import asdict

    from fields.geometry.se3 import inverse_se3

    T, covariance, camera = location.T_camera_world, location.covariance, location.camera
    data = {"picture": location.name, "time": number, "located": T is not None, "camera_from": location.note}
    if T is None or covariance is None or camera is None:
        return data | {"reason": location.reason}
    return data | {
        "T_camera_world": T.tolist(),
        "centre": inverse_se3(T)[:3, 3].tolist(),
        "inliers": location.inliers,
        "likeness": round(location.likeness, 4),
        "covariance": covariance.tolist(),
        "camera": asdict(camera),
    }
