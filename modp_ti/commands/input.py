"""What is done before a run: `modp-ti check`, `cameras` and `warmup`.

Imports are made in the commands, so that `--help` does not wait for Taichi and the readers to load.
"""

from __future__ import annotations

import time
from contextlib import ExitStack, closing
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modp_ti.commands.shared import (
    AsJson,
    Overrides,
    Quiet,
    examples,
    one_line,
    outcome,
    picture_size,
    progress_console,
)
from modp_ti.files.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from modp_ti.config.settings import SceneConfig
    from modp_ti.inputs.protocol import Tracker
    from modp_ti.inputs.sources.cameras import Camera

EXAMPLES = {
    "check": examples(
        "modp-ti check scene.yaml",
        "modp-ti check scene.yaml --quiet && modp-ti run scene.yaml",
        "modp-ti check room.mp4   (or a folder, as for modp-ti run)",
        "modp-ti check scene.yaml --json > check.json",
    ),
    "cameras": examples("modp-ti cameras", "modp-ti cameras --json"),
    "warmup": examples("modp-ti warmup scene.yaml", "modp-ti warmup --size 640x480 --size 1280x720"),
}


def check(
    scene: Annotated[Path, typer.Argument(help="scene file (YAML), whose paths are relative to it; or a recording")],
    set_: Overrides = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Look a scene's input over without mapping it. Exit code: 0 fine, 1 with warnings, 2 unusable."""
    with outcome(as_json) as result:
        from modp_ti.config.bare_recording import base_of, named_scene
        from modp_ti.config.scene_paths import refuse_output_in_input
        from modp_ti.files.run_folder import require_usable
        from modp_ti.files.terminal import CleanConsole
        from modp_ti.inputs.inspection.findings import unusable
        from modp_ti.inputs.inspection.report import judged, print_report
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
    """Describe the lens distortion that the tracker removes; empty if the tracker does not know it."""
    undistorter = tracker.undistorter
    if undistorter is None:
        return ""
    d, size = undistorter.distortion, f"images of {undistorter.raw.width}x{undistorter.raw.height}"
    if d.is_identity:
        return f"{size}, no distortion"
    words = [f"{'fisheye' if d.fisheye else 'radial'} " + " ".join(f"{k:.4g}" for k in d.numerator)]
    if d.fov:
        words = [f"FOV {d.fov:.4g}"]
    for what, coefficients in (("over", d.denominator), ("tangential", d.tangential)):
        if any(coefficients):
            words.append(f"{what} " + " ".join(f"{k:.4g}" for k in coefficients))
    return f"{size}, distortion: {', '.join(words)}"


def cameras(quiet: Quiet = False, as_json: AsJson = False) -> None:
    """List the cameras of this machine: number, name, image size and rate. Each is opened for a moment."""
    with outcome(as_json) as result:
        from modp_ti.inputs.sources.cameras import find_cameras
        from modp_ti.outputs.progress import ProgressLine

        with ProgressLine(progress_console(quiet)).working("opening the cameras"):
            found = find_cameras()
        none = "no camera found; a stream can be named by its address: modp-ti run --stream rtsp://HOST/PATH"
        result.text = "\n".join(map(_described, found)) or none
        result.data = {"cameras": [asdict(camera) for camera in found]}


def _described(camera: Camera) -> str:
    """Describe a camera: `0  HD Webcam, 640x480, 30 a second`."""
    facts = [one_line(camera.name)] if camera.name else []
    if not camera.opens:
        facts.append("cannot be opened: in use by another program, or not permitted")
    if camera.width is not None:
        facts.append(f"{camera.width}x{camera.height}")
    if camera.fps is not None:
        facts.append(f"{camera.fps:g} a second")
    return f"{camera.number}  {', '.join(facts) or 'opens'}"


def warmup(
    scene: Annotated[
        Path | None, typer.Argument(help="scene file: compiles for its settings, and for its frames without --size")
    ] = None,
    size: Annotated[
        list[str] | None, typer.Option("--size", metavar="WIDTHxHEIGHT", help="of the frames as mapped; repeatable")
    ] = None,
    set_: Overrides = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Compile all kernels of a run now, so that the first run starts as fast as the later ones."""
    with outcome(as_json) as result:
        if scene is None and set_:
            raise InputError("--set changes keys of a scene file: name one")
        if scene is None and not size:
            raise InputError("nothing to compile for: name a scene file, or give --size 640x480")
        wanted = [picture_size(text) for text in size or []] or [None]
        from modp_ti.config.scene_file import load_scene
        from modp_ti.config.settings import SceneConfig
        from modp_ti.inputs.readers.socket import SocketSettings
        from modp_ti.outputs.progress import ProgressLine

        # Without a scene, default settings with a tracker that needs no source; neither it nor the output is opened.
        plain = SceneConfig(tracker=SocketSettings(), output=Path()).without_clock()
        config = plain if scene is None else load_scene(scene, set_ or [])
        line, compiled = ProgressLine(progress_console(quiet)), []
        for one in wanted:
            start = time.perf_counter()
            with line.working("compiling kernels" if one is None else f"compiling kernels for {one[0]}x{one[1]}"):
                backend, width, height = compile_size(config, one)
            seconds = round(time.perf_counter() - start, 1)
            compiled.append({"width": width, "height": height, "backend": backend, "seconds": seconds})
        result.text = "\n".join("{width}x{height} on {backend}: {seconds} s".format(**one) for one in compiled)
        result.data = {"compiled": compiled}


def compile_size(config: SceneConfig, size: tuple[int, int] | None) -> tuple[str, int, int]:
    """Start Taichi, compile the kernels of a run, and return the backend, the width and the height.

    Taichi finds a kernel in its cache only if the same fields were created before it, so everything is created in the
    order of a run. A realtime run is made for the images that it expects, unless `size` is larger. Other runs, where
    `size` is None, are made for those of the tracker's first frame.

    Raises:
        InputError: If the device or the input cannot be used, or a live tracker is given without a size.
    """
    from fields.geometry.camera import PinholeCamera
    from fields.runtime.backend import initialise
    from modp_ti.engine.mapper import build_mapper
    from modp_ti.engine.stages import EXPECTED
    from modp_ti.engine.stream import FramesAhead
    from modp_ti.inputs.opening import open_tracker

    try:
        backend = initialise(config.device, config.threads, config.seed)
    except RuntimeError as error:
        raise InputError(str(error)) from None
    if config.is_realtime and (size is None or max(size) <= EXPECTED.width):
        camera = EXPECTED
    elif size is None and config.tracker.is_live:
        raise InputError("no frame is there before a tracker sends one: give the size, --size 640x480")
    elif size is None:
        with closing(open_tracker(config.without_clock())) as tracker:
            camera = FramesAhead(tracker, 0).first_frame().camera
    else:
        width, height = size
        camera = PinholeCamera(float(width), float(width), width / 2, height / 2, width, height)
    build_mapper(config, camera).pipeline.compile()
    return backend, camera.width, camera.height
