"""What is done with a finished run: `modp-ti render`, `export`, `view`, `measure`, `locate` and `refine`.

Imports are made in the commands, so that `--help` does not wait for Taichi and the readers to load.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from modp_ti.commands.shared import (
    AsJson,
    OnDevice,
    Quiet,
    examples,
    one_line,
    outcome,
    picture_size,
    progress_console,
)
from modp_ti.files.errors import InputError

if TYPE_CHECKING:
    from modp_ti.outputs.locating.locator import Location
    from modp_ti.outputs.playback.finished_run import FinishedRun
    from modp_ti.outputs.progress import ProgressLine

EXAMPLES = {
    "render": examples(
        "modp-ti render out/room   (the recorded path, out/room/recorded.mp4)",
        "modp-ti render out/room --path orbit --size 1280x720 --fov 70 -o orbit.webm",
        "modp-ti render out/room --show depth -o depth/   (float32 TIFF files)",
        "modp-ti render out/room --path mine.txt -o pictures/   (poses of your own)",
        "modp-ti render out/room --path smoothed --panorama 4096   (seen all round)",
    ),
    "export": examples(
        "modp-ti export out/room --format html   (one page for a friend)",
        "modp-ti export out/room --format mesh   (out/room/mesh.ply)",
        "modp-ti export out/room --format mesh --texture   (out/room/mesh.glb)",
        "modp-ti export out/room --format spz   (splats, 1/5 to 1/4 of the size)",
        "modp-ti export out/room --format nerfstudio -o data/room",
    ),
    "view": examples(
        "modp-ti view out/room", "modp-ti view splats.ply", "modp-ti view out/room --port 0 --max-splats 1000000"
    ),
    "measure": examples(
        "modp-ti measure out/room 120,200@40 310,190@40   (a length in frame 40)",
        "modp-ti measure out/room 12,20@3 60,20@3 60,45@8   (and an area)",
    ),
    "locate": examples(
        "modp-ti locate out/room new.jpg",
        "modp-ti locate out/room new/*.jpg > found.txt   (for `render --path`)",
        "modp-ti locate out/room phone.jpg --camera fx=3012,k1=0.03",
        "modp-ti locate out/room new.jpg --json",
    ),
    "refine": examples("modp-ti refine out/room", "modp-ti refine out/street --steps 5000"),
}
# The same names as in modp_ti.outputs.playback.film and export_map, whose imports would load Taichi.
PATH_NAMES = ("recorded", "smoothed", "orbit")
# fmt: off
Format = Literal[
    "points", "mesh", "collision", "splat", "spz", "sog", "sog-lod", "compressed-ply", "splat-glb", "usd", "html",
    "colmap", "nerfstudio", "video",
]
# fmt: on
NOT_FOUND = 1

Out = Annotated[Path, typer.Argument(metavar="OUT", help="output folder of a finished run")]


def opened(out: Path, quiet: bool) -> tuple[FinishedRun, ProgressLine]:
    """Read a finished run, and return it with the line that shows the progress."""
    from modp_ti.outputs.playback.finished_run import open_run
    from modp_ti.outputs.progress import ProgressLine

    line = ProgressLine(progress_console(quiet))
    with line.working("reading the run"):
        return open_run(out), line


def render(
    out: Out,
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
    show: Annotated[
        Literal["colour", "depth", "normals"],
        typer.Option(help="depth is in scene units; normals are in the camera's axes: x right, y down, z ahead"),
    ] = "colour",
    encoding: Annotated[
        Literal["tiff", "exr", "png"] | None,
        typer.Option(help="of depth and normals in a folder: `tiff` and `exr` are float32, `png` 16 bits; empty: tiff"),
    ] = None,
    panorama: Annotated[
        int | None,
        typer.Option(metavar="WIDTH", min=64, max=6400, help="equirectangular pictures, half as high as wide"),
    ] = None,
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
    device: OnDevice = "auto",
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Render a finished map along the recorded path, a smoothed one, an orbit, or any path of your own."""
    with outcome(as_json) as result:
        from modp_ti.outputs.playback.film import film, is_video, plan_flight

        run, line = opened(out, quiet)
        target = output or run.folder / f"{Path(path).stem}{'' if show == 'colour' else f'-{show}'}.mp4"
        if fps is not None and not is_video(target):
            raise InputError(f"--fps: is for videos, and {target} is a folder of pictures: leave it out")
        pixels = None if size is None else picture_size(size)
        flight = plan_flight(run, path, pixels, fov, frames, fps, smooth, exposure, panorama)
        film(run, flight, target, show, device, line, encoding)
        result.text = f"written to {target}"
        result.data = {"output": str(target.absolute()), "pictures": len(flight.poses)}


def export(
    out: Out,
    format: Annotated[
        Format,
        typer.Option(
            "--format",
            "-f",
            help="`html`: a page that shows the map in any browser, without network; `points`: coloured points (PLY); "
            "`mesh`: surface with colours (PLY, GLB, OBJ); `collision`: what is free and what solid (voxels, ROS, "
            "OctoMap, light mesh); `splat`, `spz`, `sog`, `compressed-ply`, `splat-glb`: "
            "splats for viewers; `usd`: splats in OpenUSD (needs the extra `usd`); `sog-lod`: a folder to serve, of "
            "which a browser loads what it shows; `colmap`, `nerfstudio`: images with poses and points, to train on; "
            "`video`: the path",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="PATH", help="file or new folder; empty: in OUT"),
    ] = None,
    voxel: Annotated[
        float | None,
        typer.Option(
            min=0, help="`mesh`, `collision`: edge of the voxels in scene units; empty: scene depth / 160, / 50"
        ),
    ] = None,
    texture: Annotated[
        bool, typer.Option("--texture", help="`mesh`: with a texture, as GLB (needs the extra `texture`)")
    ] = False,
    spz_version: Annotated[
        int | None, typer.Option(min=2, max=4, help="`spz`: version of the format, 2 to 4; empty: 3")
    ] = None,
    height: Annotated[
        float | None,
        typer.Option(min=0, help="`collision`: height of ROS's map above the floor; empty: that of the cameras"),
    ] = None,
    georeference: Annotated[
        bool,
        typer.Option(
            "--georeference", help="`splat-glb`, `mesh`: also a tileset with the place on the Earth, for Cesium"
        ),
    ] = False,
    device: OnDevice = "auto",
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Write a finished map as web page, points, mesh, collision shapes, compressed splats, data set or video."""
    with outcome(as_json) as result:
        from modp_ti.outputs.playback.export_map import ExportOptions, export_map

        options = ExportOptions(voxel, texture, device, spz_version, height, georeference)
        options.require_used(format)
        run, line = opened(out, quiet)
        target = export_map(run, format, output, options, line)
        result.text = f"written to {target}"
        result.data = {"output": str(target.absolute()), "format": format}


def view(
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="output folder of a finished run, or a .ply file of splats")
    ],
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="address to listen at; 0.0.0.0 is for all that reach this machine")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="port, or the next one that is free; 0 for any")] = 8080,
    max_splats: Annotated[int, typer.Option(min=100, help="splats that a browser draws, of larger maps")] = 300_000,
    device: OnDevice = "auto",
    quiet: Quiet = False,
) -> None:
    """Show a finished map, or a .ply file of splats, as a web page, until Ctrl-C."""
    with outcome(as_json=False):
        from modp_ti.config.settings import ViewSettings
        from modp_ti.outputs.playback.finished_run import open_run, open_splats
        from modp_ti.outputs.progress import ProgressLine
        from modp_ti.outputs.viewer.finished import FinishedViewer

        run = open_splats(out.expanduser()) if out.expanduser().is_file() else open_run(out)
        settings = ViewSettings(enabled=True, host=host, port=port, max_splats=max_splats)
        with ProgressLine(progress_console(quiet)).working("reading the map"):
            viewer = FinishedViewer(run, settings, device)
        typer.echo(f"viewer: {viewer.page.address}\nCtrl-C ends it")
        try:
            viewer.serve()
        except KeyboardInterrupt:
            pass
        finally:
            viewer.close()


def measure(
    out: Out,
    points: Annotated[
        list[str],
        typer.Argument(metavar="X,Y@FRAME", help="pixels of frames as mapped (those of `render`), from the top left"),
    ],
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Measure between points of the surface, each chosen as a pixel of a frame: length, and area of three or more.

    The surface lies at the median depth of the map. A deviation follows each number: that of the map's depth, and half
    a pixel.
    """
    with outcome(as_json) as result:
        from modp_ti.outputs.measuring import Ruler, point_at

        run, _ = opened(out, quiet)
        found = [point_at(run, point) for point in points]
        ruler = Ruler.of(run)
        coordinates = (" ".join(f"{x:.6g}" for x in point.xyz + run.record.origin) for point in found)
        lines = [
            f"{name}: {at} \u00b1 {p.deviation:.2g}" for name, at, p in zip(points, coordinates, found, strict=True)
        ]
        result.text = "\n".join([*lines, ruler.text(found)]).strip()
        result.data = {
            "points": [
                {"xyz": (point.xyz + run.record.origin).tolist(), "covariance": point.covariance.tolist()}
                for point in found
            ],
            "unit": ruler.unit,
            **{name: {"value": value, "deviation": spread} for name, (value, spread) in ruler.spans(found).items()},
        }


def locate(
    out: Out,
    pictures: Annotated[list[Path], typer.Argument(metavar="PICTURE", help="image files")],
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="KEY=VALUE,...",
            help="camera of the pictures, with the keys of `source.intrinsics`, such as fx=525.5,k1=-0.03; empty: the "
            "run's camera if the shape of a picture is that of the run's images, else its focal length is estimated",
        ),
    ] = None,
    device: OnDevice = "auto",
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Find where new pictures were taken in a finished map. Prints a line in TUM format for each, timed 0, 1, 2, ...

    Exit code 1: a picture was not located.
    """
    with outcome(as_json) as result:
        from modp_ti.outputs.formats.trajectory import tum_line
        from modp_ti.outputs.locating.locator import Locator, given_camera
        from modp_ti.outputs.progress import ProgressLine

        console = progress_console(quiet)
        line = ProgressLine(console)
        given = None if camera is None else given_camera(camera)
        for picture in pictures:  # before the map is loaded, which takes seconds
            if not picture.is_file():
                raise InputError(f"{picture}: {'is a folder' if picture.is_dir() else 'no such file'}; name images")
        locator = Locator(out, device, console)
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
        result.data = {"pictures": [_located(number, location) for number, location in enumerate(found)]}


def _located(number: int, location: Location) -> dict[str, Any]:
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
        from modp_ti.engine.refined_run import refine_run

        metrics = refine_run(out, steps, progress_console(quiet))
        which = "held_out" if metrics["refined"]["held_out"]["count"] else "all"
        before, after = (stage[which]["psnr"] for stage in (metrics["refinement"]["before"], metrics["refined"]))
        result.text = f"written to {out}"
        if before is not None and after is not None:
            result.text += f"; {which.replace('_', '-')} PSNR {before:.2f} dB before, {after:.2f} dB after"
        result.data = {"output": str(out.absolute()), "metrics": metrics}
