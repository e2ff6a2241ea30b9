"""The main job: `python -m modp_ti.run scene.yaml [--set key=value ...]`, the same as `modp-ti run`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modp_ti.command_line import in_one_line
from modp_ti.errors import InputError

__all__ = ["run"]


def run(
    scene: Annotated[Path, typer.Argument(help="scene file (YAML); its paths are relative to it")],
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="overrides a key, for example --set source.scale=0.5"),
    ] = None,
    view: Annotated[bool, typer.Option("--view", help="serve a web page that shows the map as it grows")] = False,
    more: Annotated[list[str] | None, typer.Argument(metavar="KEY=VALUE", hidden=True)] = None,
) -> None:
    """Map a posed sequence while its frames arrive, and write splats, poses, metrics and pictures."""
    with in_one_line():
        folder = _run(scene, [*(["view.enabled=true"] if view else []), *(set_ or []), *(more or [])])
    typer.echo(f"written to {folder}")


def _run(scene: Path, overrides: list[str]) -> Path:
    # Imported here: asking for help must not wait for the compiler and the readers.
    from modp_ti.config import load_scene

    config = load_scene(scene, overrides)
    if config.output.exists() and not config.output.is_dir():
        raise InputError(f"{config.output}: output must be a folder, this is a file")

    from rich.console import Console

    from modp_ti.session import run_scene

    return run_scene(config, Console())


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(run)
    app()
