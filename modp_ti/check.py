"""`modp-ti check scene.yaml`: reads everything, maps nothing, says what is wrong and how to mend it."""

from __future__ import annotations

import json
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modp_ti.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from modp_ti.inspection.report import Report
    from modp_ti.settings import SceneConfig
    from modp_ti.trackers import Tracker

__all__ = ["check", "inspect_scene"]


def check(
    scene: Annotated[Path, typer.Argument(help="scene file (YAML); its paths are relative to it")],
    as_json: Annotated[bool, typer.Option("--json", help="print the findings as JSON")] = False,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="overrides a key, for example --set source.scale=0.5"),
    ] = None,
) -> None:
    """Look a scene's input over without mapping it. Exit code: 0 fine, 1 with warnings, 2 unusable."""
    # Imported here: asking for help must not wait for the readers.
    from rich.console import Console

    from modp_ti.config import load_scene
    from modp_ti.inspection import report as reports
    from modp_ti.inspection.finding import Finding, Severity, verdict

    try:
        report = inspect_scene(load_scene(scene, set_ or []), Console(stderr=True))
    except InputError as error:
        report = reports.Report(findings=[Finding(Severity.UNUSABLE, "input", " ".join(str(error).split()))])
    if as_json:
        typer.echo(json.dumps(reports.as_json(report), indent=2))
    else:
        reports.print_report(report, Console())
    raise typer.Exit(verdict(report.findings)[1])


def inspect_scene(config: SceneConfig, console: Console) -> Report:
    """Iterate over the scene's tracker once and judge what it delivers. Progress is shown on `console`.

    Raises InputError for input that cannot be read at all.
    """
    from fields.backend import initialise
    from modp_ti.inspection.geometry import judge_geometry, measure_geometry
    from modp_ti.inspection.pictures import judge_sequence
    from modp_ti.inspection.report import Report
    from modp_ti.inspection.scale import judge_scale, measure_scale
    from modp_ti.inspection.survey import survey
    from modp_ti.progress import ProgressLine
    from modp_ti.trackers import close, frame_count, open_tracker

    if config.tracker.kind == "synthetic":
        initialise("cpu", config.threads, config.seed)  # its frames are rendered
    line = ProgressLine(console)
    tracker = open_tracker(config, line.prepare)
    try:
        frames = iter(tracker)
        first = next(frames, None)
        if first is None:
            raise InputError("the tracker delivered no frame: nothing to check")
        total = frame_count(tracker)
        line.start_mapping(total, "checking")
        try:
            seen = survey(chain([first], frames), total, lambda _: line.frame(None))
        finally:
            line.stop()
        geometry, scale = measure_geometry(seen), measure_scale(seen.frames)
        findings = [
            *judge_geometry(geometry),
            *judge_sequence(seen.frames),
            *judge_scale(seen.frames, scale, config.mapping.keyframes.min_points),
        ]
        return Report(seen.frames, geometry, scale, _lens(tracker), list(tracker.notes), findings)
    finally:
        close(tracker)


def _lens(tracker: Tracker) -> str:
    """The distortion that the tracker's images are freed from; empty where it does not say."""
    frames = getattr(tracker, "frames", ())
    if not len(frames) or not hasattr(frames[0], "undistorter"):
        return ""
    undistorter = frames[0].undistorter
    size = f"images of {undistorter.raw.width}x{undistorter.raw.height}"
    d = undistorter.distortion
    if d.is_identity:
        return f"{size}, no distortion"
    words = [f"{'fisheye' if d.fisheye else 'radial'} " + " ".join(f"{k:.4g}" for k in d.numerator)]
    if any(d.denominator):
        words.append("over " + " ".join(f"{k:.4g}" for k in d.denominator))
    if any(d.tangential):
        words.append("tangential " + " ".join(f"{k:.4g}" for k in d.tangential))
    return f"{size}, distortion: {', '.join(words)}"


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(check)
    app()
