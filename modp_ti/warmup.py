"""Compiling ahead of time: `modp-ti warmup`, the same as `python -m modp_ti.warmup`, fills Taichi's offline cache."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modp_ti.command_line import in_one_line, picture_size
from modp_ti.errors import InputError

if TYPE_CHECKING:
    from modp_ti.settings import SceneConfig

__all__ = ["compile_size", "warmup"]


def warmup(
    scene: Annotated[
        Path | None, typer.Argument(help="scene file: compiles for its settings, and for its frames without --size")
    ] = None,
    size: Annotated[
        list[str] | None, typer.Option("--size", metavar="WIDTHxHEIGHT", help="of the frames as mapped; repeatable")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="overrides a key of the scene file"),
    ] = None,
) -> None:
    """Compile all kernels of a run now, so that the first run starts as fast as the later ones."""
    with in_one_line():
        _warmup(scene, size or [], set_ or [], typer.echo)


def _warmup(scene: Path | None, sizes: list[str], overrides: list[str], say: Callable[[str], None]) -> None:
    if scene is None and overrides:
        raise InputError("--set changes keys of a scene file: name one")
    if scene is None and not sizes:
        raise InputError("nothing to compile for: name a scene file, or give --size 640x480")
    wanted = [picture_size(text) for text in sizes] or [None]
    # Imported here: asking for help must not wait for the compiler and the readers.
    from modp_ti.config import load_scene
    from modp_ti.settings import SceneConfig, TrackerSettings

    if scene is None:
        # Any scene of default settings; nothing of it is opened.
        config = SceneConfig(tracker=TrackerSettings(kind="synthetic"), output=Path())
    else:
        config = load_scene(scene, overrides)
    for size in wanted:
        start = time.perf_counter()
        backend, width, height = compile_size(config, size)
        say(f"{width}x{height} on {backend}: {time.perf_counter() - start:.1f} s")


def compile_size(config: SceneConfig, size: tuple[int, int] | None) -> tuple[str, int, int]:
    """Start Taichi and compile what a run of the scene does; return the backend, width and height.

    size: (width, height) of the frames; None takes it from the tracker's first frame. Taichi finds a kernel in its
    cache only where the same fields were made before it, so all is made in the order of a run. Raises InputError as a
    run does.
    """
    from fields.backend import initialise
    from fields.camera import PinholeCamera
    from modp_ti.session import build_mapper
    from modp_ti.trackers import open_tracker

    try:
        backend = initialise(config.device, config.threads, config.seed)
    except RuntimeError as error:
        raise InputError(str(error)) from None
    if size is None and config.tracker.kind == "socket":
        raise InputError("no frame is there before a tracker sends one: give the size, --size 640x480")
    if size is None:
        first = next(iter(open_tracker(config)), None)
        if first is None:
            raise InputError("the tracker delivered no frame: nothing to compile for")
        camera = first.camera
    else:
        width, height = size
        camera = PinholeCamera(float(width), float(width), width / 2, height / 2, width, height)
    build_mapper(config, camera).pipeline.compile()
    return backend, camera.width, camera.height


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(warmup)
    app()
