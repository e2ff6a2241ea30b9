"""`modp-ti check scene.yaml`: reads the whole input without mapping it, and reports problems and corrections."""

from __future__ import annotations

from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modp_ti.commands.shared import AsJson, Overrides, Quiet, examples, one_line, outcome, progress_console, standalone
from modp_ti.files.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from modp_ti.config.settings import SceneConfig
    from modp_ti.inputs.protocol import Tracker

EXAMPLES = examples(
    "modp-ti check scene.yaml",
    "modp-ti check scene.yaml --quiet && modp-ti run scene.yaml",
    "modp-ti check room.mp4   (or a folder, as for modp-ti run)",
    "modp-ti check scene.yaml --json > check.json",
)


def check(
    scene: Annotated[Path, typer.Argument(help="scene file (YAML), whose paths are relative to it; or a recording")],
    set_: Overrides = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Look a scene's input over without mapping it. Exit code: 0 fine, 1 with warnings, 2 unusable."""
    with outcome(as_json) as result:
        # Imported here, so that `--help` does not wait for the readers to load.
        from modp_ti.files.run_folder import require_usable
        from modp_ti.files.terminal import CleanConsole
        from modp_ti.inputs.bare_recording import base_of, named_scene
        from modp_ti.inputs.inspection.findings import unusable
        from modp_ti.inputs.inspection.report import judged, print_report
        from modp_ti.inputs.scene_paths import refuse_output_in_input
        from modp_ti.outputs.progress import ProgressLine

        try:
            console = progress_console(quiet)
            config = named_scene(scene, set_ or [], say=ProgressLine(console).note)
            refuse_output_in_input(config, base_of(scene))
            require_usable(config.output)
            data = inspect_scene(config, console)
        except InputError as error:
            data = judged([unusable("input", one_line(error))])
        result.code, result.data = data["exit_code"], data
        if not as_json:
            print_report(data, CleanConsole())


def inspect_scene(config: SceneConfig, console: Console) -> dict[str, Any]:
    """Iterate over a scene's tracker once and judge its frames. Raises InputError if the input cannot be read.

    Returns:
        Verdict, findings and measurements as plain data for JSON.
    """
    from modp_ti.inputs.delivered_frames import settled
    from modp_ti.inputs.inspection.findings import judge_scale, judge_sequence, measure_scale
    from modp_ti.inputs.inspection.geometry import judge_geometry, measure_geometry
    from modp_ti.inputs.inspection.report import judged, measured
    from modp_ti.inputs.inspection.survey import survey
    from modp_ti.inputs.opening import open_tracker
    from modp_ti.outputs.progress import ProgressLine

    line, config = ProgressLine(console), config.without_clock()
    with ExitStack() as held:
        if not (config.output / "sfm").is_dir():  # the tracker `sfm` leaves its model there
            output = Path(held.enter_context(TemporaryDirectory(prefix="modp-ti-check-")))
            config = config.model_copy(update={"output": output})
        tracker = open_tracker(config, line.prepare)
        held.callback(tracker.close)
        frames = settled(tracker)
        first = next(frames, None)
        if first is None:
            raise InputError("the tracker delivered no frame: nothing to check")
        total = tracker.frame_count
        line.start("checking", total)
        try:
            seen = survey(chain([first], frames), total, lambda _: line.frame(None))
        finally:
            line.stop()
        with line.working("comparing conventions"):
            geometry, scale = measure_geometry(seen), measure_scale(seen.frames)
        findings = [
            *judge_geometry(geometry),
            *judge_sequence(seen.frames),
            *judge_scale(seen.frames, scale, config.mapping.keyframes.min_points),
        ]
        return judged(findings, tracker.notes) | measured(seen.frames, geometry, scale, _lens(tracker))


def _lens(tracker: Tracker) -> str:
    """Describe the lens distortion that the tracker removes; empty if the tracker does not tell."""
    undistorter = tracker.undistorter
    if undistorter is None:
        return ""
    size = f"images of {undistorter.raw.width}x{undistorter.raw.height}"
    d = undistorter.distortion
    if d.is_identity:
        return f"{size}, no distortion"
    words = [f"{'fisheye' if d.fisheye else 'radial'} " + " ".join(f"{k:.4g}" for k in d.numerator)]
    if d.fov:
        words = [f"FOV {d.fov:.4g}"]
    if any(d.denominator):
        words.append("over " + " ".join(f"{k:.4g}" for k in d.denominator))
    if any(d.tangential):
        words.append("tangential " + " ".join(f"{k:.4g}" for k in d.tangential))
    return f"{size}, distortion: {', '.join(words)}"


if __name__ == "__main__":
    standalone(check, EXAMPLES)
