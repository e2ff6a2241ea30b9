"""`modp-ti clean` and `modp-ti crop`: a finished map without its faults, or a part of it, in a new folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modp_ti.commands.finished import Out
from modp_ti.commands.shared import AsJson, Quiet, examples, outcome, progress_console
from modp_ti.files.errors import InputError

EXAMPLES = {
    "clean": examples("modp-ti clean out/room   (out/room-clean)", "modp-ti clean out/room -o out/tidy"),
    "crop": examples(
        "modp-ti crop out/room --around-cameras 3   (out/room-crop)",
        "modp-ti crop out/room --box -2,-1.5,0,2,1.5,4 --above -1.2 -o out/table",
    ),
}
Output = Annotated[
    Path | None, typer.Option("--output", "-o", metavar="PATH", help="the new folder; empty: OUT-clean or OUT-crop")
]


def clean(out: Out, output: Output = None, quiet: Quiet = False, as_json: AsJson = False) -> None:
    """Remove floaters, giants, needles and what no frame has seen from a finished map. OUT stays as it is."""
    with outcome(as_json) as result:
        from modp_ti.engine.edited_run import clean_run

        target = _target(out, output, "clean")
        entry = clean_run(out, target, progress_console(quiet))
        removed = ", ".join(f"{count} {kind}" for kind, count in entry["removed"].items())
        which = "held-out" if entry["held_out"] else "keyframes'"
        result.text = (
            f"written to {target}; removed {removed} of {entry['kept'] + sum(entry['removed'].values())}; "
            f"{which} PSNR {entry['before']:.2f} dB before, {entry['after']:.2f} dB after"
        )
        result.data = {"output": str(target.absolute()), **entry}


def crop(
    out: Out,
    output: Output = None,
    box: Annotated[
        str | None, typer.Option(metavar="X,Y,Z,X,Y,Z", help="between two opposite corners of a box")
    ] = None,
    sphere: Annotated[str | None, typer.Option(metavar="X,Y,Z,R", help="centre and radius of a sphere")] = None,
    around_cameras: Annotated[
        float | None, typer.Option(metavar="M", min=0, help="at most so far from the nearest camera")
    ] = None,
    above: Annotated[
        float | None,
        typer.Option(metavar="H", help="at least so high over the middle of the cameras, along their mean up"),
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Keep the part of a finished map that lies in all the given regions. OUT stays as it is.

    Numbers are in the units and axes of OUT/trajectory.txt.
    """
    with outcome(as_json) as result:
        region = _numbers("--box", box, 6), _numbers("--sphere", sphere, 4), around_cameras, above
        if all(part is None for part in region):
            raise InputError("crop needs a region: --box, --sphere, --around-cameras or --above")
        from modp_ti.engine.edited_run import Region, crop_run

        target = _target(out, output, "crop")
        entry = crop_run(out, target, Region(*region))
        result.text = f"written to {target}; {entry['kept']} Gaussians kept, {entry['removed']} removed"
        result.data = {"output": str(target.absolute()), **entry}


def _target(out: Path, output: Path | None, suffix: str) -> Path:
    out = out.expanduser().resolve()
    return out.with_name(f"{out.name}-{suffix}") if output is None else output.expanduser()


def _numbers(option: str, text: str | None, count: int) -> list[float] | None:
    """Parse numbers with commas. Raises InputError if they are not so many finite ones."""
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or any(abs(number) == float("inf") or number != number for number in numbers):
        raise InputError(f"{option} {text}: write {count} numbers with commas and no spaces")
    return numbers
