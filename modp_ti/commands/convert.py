"""`modp-ti convert A B`: converts splats from one format to another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modp_ti.commands.shared import AsJson, Quiet, examples, outcome, progress_console
from modp_ti.files.errors import InputError

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
    spz_version: Annotated[
        int | None, typer.Option(min=2, max=4, help="version of an .spz file, 2 to 4; empty: 3")
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Convert splats from one format to another."""
    with outcome(as_json) as result:
        # Imported here, so that `--help` does not wait for Taichi and the readers to load.
        from modp_ti.outputs.formats.splat_files import convert_splats
        from modp_ti.outputs.formats.spz import DEFAULT_VERSION
        from modp_ti.outputs.progress import ProgressLine

        if spz_version is not None and target.suffix.lower() != ".spz":
            raise InputError(f"--spz-version: is for .spz files, not for {target}: leave it out")
        line = ProgressLine(progress_console(quiet))
        with line.working("converting"):
            given = source.expanduser(), target.expanduser(), spz_version or DEFAULT_VERSION
            count = convert_splats(*given, lambda text: line.note(f"note: {text}"))
        result.text = f"written to {target}"
        result.data = {"output": str(target.absolute()), "gaussians": count}
