"""`modp-ti warmup`: compiles kernels ahead of time into Taichi's offline cache."""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modp_ti.commands.shared import (
    AsJson,
    Overrides,
    Quiet,
    examples,
    outcome,
    picture_size,
    progress_console,
    standalone,
)
from modp_ti.files.errors import InputError

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig

EXAMPLES = examples("modp-ti warmup scene.yaml", "modp-ti warmup --size 640x480 --size 1280x720")


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
        compiled = _warmup(scene, size or [], set_ or [], quiet)
        result.text = "\n".join("{width}x{height} on {backend}: {seconds} s".format(**one) for one in compiled)
        result.data = {"compiled": compiled}


def _warmup(scene: Path | None, sizes: list[str], overrides: list[str], quiet: bool) -> list[dict[str, Any]]:
    """Compile for each size. Returns width, height, backend and seconds of each."""
    if scene is None and overrides:
        raise InputError("--set changes keys of a scene file: name one")
    if scene is None and not sizes:
        raise InputError("nothing to compile for: name a scene file, or give --size 640x480")
    wanted = [picture_size(text) for text in sizes] or [None]
    # Imported here, so that `--help` does not wait for Taichi and the readers to load.
    from modp_ti.config.scene_file import load_scene
    from modp_ti.config.settings import SceneConfig
    from modp_ti.inputs.readers.socket import SocketSettings

    if scene is None:
        # A placeholder with default settings, of a tracker that needs no source; neither it nor the output is opened.
        config = SceneConfig(tracker=SocketSettings(), output=Path()).without_clock()
    else:
        config = load_scene(scene, overrides)
    from modp_ti.outputs.progress import ProgressLine

    line, compiled = ProgressLine(progress_console(quiet)), []
    for size in wanted:
        start = time.perf_counter()
        with line.working("compiling kernels" if size is None else f"compiling kernels for {size[0]}x{size[1]}"):
            backend, width, height = compile_size(config, size)
        seconds = round(time.perf_counter() - start, 1)
        compiled.append({"width": width, "height": height, "backend": backend, "seconds": seconds})
    return compiled


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


if __name__ == "__main__":
    standalone(warmup, EXAMPLES)
