"""`modp-ti convert A B`: converts splats from one format to another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modp_ti.commands.shared import AsJson, Quiet, examples, outcome, progress_console

__all__ = ["EXAMPLES", "convert"]

EXAMPLES = examples("modp-ti convert scene.spz scene.ply", "modp-ti convert out/room/splats.ply room.sog")


def convert(
    source: Annotated[
        Path, typer.Argument(metavar="A", help="splats: .ply (3DGS, compressed), .spz, .sog, .splat, .ksplat")
    ],
    target: Annotated[
        Path,
        typer.Argument(metavar="B", help="file to write: .ply, .compressed.ply, .spz, .sog, .splat, .ksplat, .glb"),
    ],
    spz_version: Annotated[int, typer.Option(min=2, max=4, help="version of an .spz file, 2 to 4")] = 3,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Convert splats from one format to another."""
    with outcome(as_json) as result:
        # Imported here, so that `--help` does not wait for Taichi and the readers to load.
        from modp_ti.outputs.formats.splat_files import convert_splats
        from modp_ti.outputs.progress import ProgressLine

        with ProgressLine(progress_console(quiet)).working("converting"):
            count = convert_splats(source.expanduser(), target.expanduser(), spz_version)
        result.text = f"written to {target}"
        result.data = {"output": str(target.absolute()), "gaussians": count}
