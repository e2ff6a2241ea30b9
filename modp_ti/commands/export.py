"""`modp-ti export OUT --format ...`: exports a finished map for other programs."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from modp_ti.commands.shared import AsJson, Device, Quiet, examples, outcome, progress_console

__all__ = ["EXAMPLES", "export"]

EXAMPLES = examples(
    "modp-ti export out/room --format html   (one page for a friend)",
    "modp-ti export out/room --format mesh   (out/room/mesh.ply)",
    "modp-ti export out/room --format mesh --texture   (out/room/mesh.glb)",
    "modp-ti export out/room --format spz   (splats, 1/5 to 1/4 of the size)",
    "modp-ti export out/room --format nerfstudio -o data/room",
)


class Format(str, Enum):
    """Export formats."""

    points = "points"
    mesh = "mesh"
    splat = "splat"
    spz = "spz"
    sog = "sog"
    sog_lod = "sog-lod"
    compressed_ply = "compressed-ply"
    splat_glb = "splat-glb"
    html = "html"
    colmap = "colmap"
    nerfstudio = "nerfstudio"
    video = "video"


def export(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="output folder of a finished run")],
    format: Annotated[
        Format,
        typer.Option(
            "--format",
            "-f",
            help="`html`: a page that shows the map in any browser, without network; `points`: coloured points (PLY); "
            "`mesh`: surface with colours (PLY, GLB, OBJ); `splat`, `spz`, `sog`, `compressed-ply`, `splat-glb`: "
            "splats for viewers; `sog-lod`: a folder to serve, of which a browser loads what it shows; `colmap`, "
            "`nerfstudio`: images with poses and points, to train on; `video`: the path",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="PATH", help="file or new folder; empty: in OUT"),
    ] = None,
    voxel: Annotated[
        float | None, typer.Option(min=0, help="`mesh`: edge of its voxels in scene units; empty: scene depth / 160")
    ] = None,
    texture: Annotated[
        bool, typer.Option("--texture", help="`mesh`: with a texture, as GLB (needs the extra `texture`)")
    ] = False,
    spz_version: Annotated[
        int | None, typer.Option(min=2, max=4, help="`spz`: version of the format, 2 to 4; empty: 3")
    ] = None,
    device: Annotated[Device, typer.Option(help="`auto`: CUDA if there is a GPU, otherwise the CPU")] = Device.auto,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Write a finished map as web page, points, mesh, compressed splats, data set or video."""
    with outcome(as_json) as result:
        # Imported here, so that `--help` does not wait for Taichi and the readers to load.
        from modp_ti.outputs.playback.export_map import ExportOptions, export_map
        from modp_ti.outputs.playback.finished_run import open_run
        from modp_ti.outputs.progress import ProgressLine

        options = ExportOptions(voxel, texture, device.value, spz_version)
        options.require_used(format.value)
        line = ProgressLine(progress_console(quiet))
        with line.working("reading the run"):
            run = open_run(out)
        target = export_map(run, format.value, output, options, line)
        result.text = f"written to {target}"
        result.data = {"output": str(target.absolute()), "format": format.value}
