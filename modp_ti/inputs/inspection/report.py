"""Reports of an inspection, as tables and as JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from modp_ti.inputs.inspection.conventions import CONVENTIONS
from modp_ti.inputs.inspection.findings import Finding, Scale, faulty_frames, verdict
from modp_ti.inputs.inspection.geometry import Geometry
from modp_ti.inputs.inspection.survey import FrameRecord

SIGNS = {"note": "note", "warning": "[yellow]warning[/]", "unusable": "[red]unusable[/]"}


def judged(findings: Sequence[Finding], notes: Sequence[str] = ()) -> dict[str, Any]:
    """Return findings and notes of the tracker with the verdict, as plain data for JSON."""
    word, code = verdict(findings)
    told = [{"severity": f.severity.value, "code": f.code, "text": f.text, "mend": f.mend} for f in findings]
    return {"verdict": word, "exit_code": code, "findings": told, "notes": list(notes)}


def measured(frames: Sequence[FrameRecord], geometry: Geometry, scale: Scale, lens: str) -> dict[str, Any]:
    """Return the measurements as plain data for JSON. Numbers that are not finite become None.

    Args:
        frames: Measurements of each frame.
        geometry: Agreement of poses and intrinsics with the images.
        scale: Depth of the scene and motion of the camera.
        lens: The lens distortion in words.
    """
    camera, faulty = frames[0].camera, faulty_frames(frames)
    points = np.array([frame.points for frame in frames])
    steps = np.diff([frame.timestamp for frame in frames])
    return {
        "frames": len(frames),
        "held_out": sum(frame.held_out for frame in frames),
        "size": [camera.width, camera.height],
        "intrinsics": {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy},
        "cameras": len({frame.camera for frame in frames}),
        "lens": lens,
        "masked": _number(np.mean([frame.masked for frame in frames])),
        "seconds": _number(frames[-1].timestamp - frames[0].timestamp),
        "seconds_between_frames": _number(np.median(steps)) if len(steps) else None,
        **{fault: [frames[i].name for i in faulty[fault]] for fault in ("time_gaps", "blurred", "duplicates")},
        "points": {"median": int(np.median(points)), "least": int(points.min()), "most": int(points.max())},
        "scale": {
            "depth": _number(scale.depth),
            "step": _number(scale.step),
            "longest_step": _number(scale.longest),
            "extent": _number(scale.extent),
        },
        "conventions": [
            {
                "name": c.name,
                "features_fit": _number(geometry.epipolar[c].share),
                "epipolar_error": _number(geometry.epipolar[c].error),
                "reprojection_error": _number(geometry.reprojection[c]) if geometry.points else None,
            }
            for c in CONVENTIONS
        ],
        "matched_features": geometry.epipolar[CONVENTIONS[0]].matches,
        "observations": geometry.points,
    }


def print_report(data: dict[str, Any], console: Console) -> None:
    """Print the notes, tables, findings with corrections, and verdict of `judged` and `measured`."""
    for note in data["notes"]:
        console.print(f"note: {note}", highlight=False, soft_wrap=True, markup=False)
    if "frames" in data:
        console.print(_overview(data))
        console.print(_conventions(data))
    for finding in data["findings"]:
        console.print(f"{SIGNS[finding['severity']]}: ", end="", highlight=False, markup=True)
        console.print(finding["text"], highlight=False, soft_wrap=True, markup=False)
        if finding["mend"]:
            console.print(f"    -> {finding['mend']}", highlight=False, soft_wrap=True, markup=False)
    console.print(f"verdict: {data['verdict']}", highlight=False)


def _overview(data: dict[str, Any]) -> Table:
    table = Table(show_header=False, box=None, pad_edge=False)
    k, s, p = data["intrinsics"], data["scale"], data["points"]
    rows = {
        "frames": f"{data['frames']}, {data['held_out']} held out",
        "size": "{}x{}".format(*data["size"]),
        "intrinsics": "fx {fx:.2f}  fy {fy:.2f}  cx {cx:.2f}  cy {cy:.2f}".format(**k)
        + (f"  ({data['cameras']} cameras)" if data["cameras"] > 1 else ""),
        "lens": data["lens"],
        "masked": f"{data['masked']:.1%} of the pixels",
        "time": f"{data['seconds']:.2f} s, {len(data['time_gaps'])} gaps",
        "pictures": f"{len(data['blurred'])} blurred, {len(data['duplicates'])} repeated",
        "points a frame": f"{p['median']} (median), {p['least']} to {p['most']}",
        "scene": f"depth {_shown(s['depth'])} units; the camera moves by {_shown(s['step'])} depths a frame "
        f"(at most {_shown(s['longest_step'])}), over {_shown(s['extent'])} in all",
    }
    for name, text in rows.items():
        if text:
            table.add_row(name, text)
    return table


def _conventions(data: dict[str, Any]) -> Table:
    table = Table(caption=f"{data['matched_features']:,} matched features, {data['observations']:,} observed points")
    table.add_column("poses and intrinsics", no_wrap=True)
    for heading in ("features fit", "epipolar error [px]", "points' error [px]"):
        table.add_column(heading, justify="right")
    for row in data["conventions"]:
        share = "–" if row["features_fit"] is None or not data["matched_features"] else f"{row['features_fit']:.0%}"
        table.add_row(row["name"], share, _shown(row["epipolar_error"]), _shown(row["reprojection_error"]))
    return table


def _shown(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _number(value: float | np.floating) -> float | None:
    return float(f"{float(value):.6g}") if math.isfinite(value) else None
