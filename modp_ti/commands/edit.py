"""`modp-ti clean`, `crop` and `scale`: a finished map without faults, a part of it, or in metres, in a new folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from modp_ti.commands.finished import Out, opened
from modp_ti.commands.shared import AsJson, Quiet, examples, outcome, progress_console
from modp_ti.files.errors import InputError

EXAMPLES = {
    "clean": examples("modp-ti clean out/room   (out/room-clean)", "modp-ti clean out/room -o out/tidy"),
    "crop": examples(
        "modp-ti crop out/room --around-cameras 3   (out/room-crop)",
        "modp-ti crop out/room --box -2,-1.5,0,2,1.5,4 --above -1.2 -o out/table",
    ),
    "scale": examples(
        "modp-ti scale out/room --from 12,80@40 --to 300,85@40 --metres 2.1",
        "modp-ti scale out/room --marker tag36h11 --metres 0.16 --upright",
        "modp-ti scale out/walk --gps   (also upright, with its place on the Earth)",
    ),
}
# The same names as in modp_ti.outputs.locating.markers, whose imports take seconds.
Family = Literal["tag16h5", "tag25h9", "tag36h10", "tag36h11", "aruco", "4x4", "5x5", "6x6", "7x7"]
Output = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="PATH", help="the new folder; empty: OUT-clean, OUT-crop or OUT-scale"),
]


def clean(out: Out, output: Output = None, quiet: Quiet = False, as_json: AsJson = False) -> None:
    """Remove floaters, giants, needles and what no frame has seen from a finished map. OUT stays as it is."""
    with outcome(as_json) as result:
        from modp_ti.engine.cleaned import said
        from modp_ti.engine.edited_run import clean_run

        target = _target(out, output, "clean")
        entry = clean_run(out, target, progress_console(quiet))
        result.text = f"written to {target}; {said(entry)}"
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
        typer.Option(metavar="H", help="at least so high over the middle of the cameras, along the world's up"),
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


def scale(
    out: Out,
    output: Output = None,
    start: Annotated[
        str | None, typer.Option("--from", metavar="X,Y@FRAME", help="a pixel of a frame, as for `measure`")
    ] = None,
    end: Annotated[str | None, typer.Option("--to", metavar="X,Y@FRAME", help="another one")] = None,
    marker: Annotated[
        Family | None, typer.Option(help="family of markers that the frames show, instead of two pixels")
    ] = None,
    metres: Annotated[
        float | None, typer.Option(min=1e-6, help="the length between the two points, or of a marker's black edge")
    ] = None,
    upright: Annotated[
        bool,
        typer.Option(
            "--upright", help="turn the world so that y points down, by a video's gravity or by vertical edges"
        ),
    ] = False,
    gps: Annotated[
        bool,
        typer.Option("--gps", help="by GPS positions of the recording (EXIF, GPMF, NavSatFix), in metres and upright"),
    ] = False,
    gps_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="by the positions of a GPX or CSV file, instead of --gps")
    ] = None,
    gps_offset: Annotated[float, typer.Option(metavar="S", help="seconds to add to the times of --gps-file")] = 0.0,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Give a finished map metres, by one length, markers or GPS, or make it upright. OUT stays as it is."""
    with outcome(as_json) as result:
        by_points, by_gps = start is not None and end is not None, gps or gps_file is not None
        if (start is None) != (end is None) or by_points + (marker is not None) + by_gps > 1:
            raise InputError("--from and --to go together, or instead of both --marker, --gps or --gps-file")
        if (by_points or marker is not None) != (metres is not None) or not (metres or upright or by_gps):
            raise InputError("scale needs --metres with --from and --to or with --marker, or --gps, or --upright")
        import numpy as np

        from modp_ti.engine.edited_run import scale_run
        from modp_ti.inputs.positions import read_positions, recorded_positions
        from modp_ti.outputs.locating.georeference import georeference
        from modp_ti.outputs.locating.markers import marker_scale
        from modp_ti.outputs.locating.vertical import vertical
        from modp_ti.outputs.measuring import length, point_at
        from modp_ti.outputs.playback.run_frames import run_settings
        from modp_ti.outputs.splat_page.page import Y, levelled, turning

        target = _target(out, output, "scale")
        run, line = opened(out, quiet)
        factor, R, t, about, said = 1.0, np.eye(3), np.zeros(3), {}, [f"written to {target}"]
        if metres is not None:
            if marker is not None:
                factor, deviation, count = marker_scale(run, marker, metres, line)
                by = f"{count} marker{'s' if count > 1 else ''}"
            else:
                measured, spread = length([point_at(run, point) for point in (start or "", end or "")])
                if measured <= spread:
                    raise InputError(f"the points are {measured:.3g} \u00b1 {spread:.2g} apart: choose others")
                factor, deviation, by = metres / measured, spread / measured, "one length"
            about |= {"unit": "m", "deviation": deviation, "by": by}
            said.append(f"{factor:.6g} m per unit by {by}, \u00b1 {100 * deviation:.2g} %")
        if upright or by_gps:
            found = vertical(run, line)
            R = turning(levelled(run).R[1] if found is None else found.down, Y)
            tilt = None if found is None else float(np.degrees(found.deviation))
            about |= {"down": Y.tolist(), "down_deviation": tilt}
            if found is not None:
                said.append(f"upright by {found.by}, \u00b1 {tilt:.1g} degrees")
            elif not by_gps:
                said.append("upright as far as the cameras were held without roll: too few vertical edges")
            if by_gps:
                path = run_settings(run).source.require_path()
                own = recorded_positions(path, run.names) if gps_file is None else None
                place = georeference(
                    run, own or read_positions(gps_file or path, path, gps_offset), found and found.down
                )
                factor, R, t, about = place.s, place.R, place.t, about | place.about
                said.append(place.text)
        scale_run(out, target, factor, R, about, t)
        result.text = "; ".join(said)
        result.data = {"output": str(target.absolute()), "factor": factor, **about}


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
