"""`modp-ti run scene.yaml [--set key=value ...]`: maps a scene, as `python -m modp_ti.run` does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from modp_ti.commands.shared import AsJson, Overrides, Quiet, examples, outcome, progress_console
from modp_ti.config.presets import PRESETS
from modp_ti.files.errors import InputError

__all__ = ["EXAMPLES", "run"]

EXAMPLES = examples(
    "modp-ti run scene.yaml",
    "modp-ti run scene.yaml --fast   (a first look; --best for a map to keep)",
    "modp-ti run scene.yaml --set source.scale=0.5 --set refine.steps=3000",
    "modp-ti run scene.yaml --set mode=offline --set output=out/3dgs",
    "modp-ti run scene.yaml --set snapshot_every=50",
    "modp-ti run --resume OUT   (after a crash or Ctrl-C)",
    "modp-ti run --replay OUT   (repeat a recorded realtime run)",
    "modp-ti run scene.yaml --quiet --json > result.json",
)


def run(
    scene: Annotated[
        Path | None, typer.Argument(help="scene file (YAML); its paths are relative to it; not needed with --resume")
    ] = None,
    set_: Overrides = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            "--resume", metavar="OUT", help="go on with the run whose output folder this is, from its snapshot"
        ),
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option(
            "--replay", metavar="OUT", help="repeat the realtime run whose output folder this is, from its session.zip"
        ),
    ] = None,
    fast: Annotated[bool, typer.Option("--fast", help=f"{PRESETS['fast'].purpose} (docs/configuration.md)")] = False,
    best: Annotated[bool, typer.Option("--best", help=f"{PRESETS['best'].purpose} (docs/configuration.md)")] = False,
    view: Annotated[bool, typer.Option("--view", help="serve a web page that shows the map as it grows")] = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
    more: Annotated[list[str] | None, typer.Argument(metavar="KEY=VALUE", hidden=True)] = None,
) -> None:
    """Map a posed sequence while its frames arrive, and write splats, poses, metrics, pictures and a report."""
    if scene is None and resume is None and replay is None:
        raise typer.BadParameter("name a scene file, or the output folder of a run to go on with (--resume OUT)")
    if replay is not None and (scene is not None or resume is not None):
        raise typer.BadParameter("--replay OUT repeats a whole run: give neither a scene file nor --resume")
    with outcome(as_json) as result:
        overrides = [*(["view.enabled=true"] if view else []), *(set_ or []), *(more or [])]
        preset = _preset(scene, fast, best)
        folder = _run(scene, resume, overrides, preset, quiet) if replay is None else _replay(replay, overrides, quiet)
        result.text = f"written to {folder}"
        if as_json:
            metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
            result.data = {"output": str(folder), "metrics": metrics}


def _preset(scene: Path | None, fast: bool, best: bool) -> str | None:
    """Return the name of the preset that was asked for. Raises InputError if it is not clear or has no effect."""
    if fast and best:
        raise InputError("--fast and --best are two presets: give one of them")
    preset = "fast" if fast else "best" if best else None
    if preset is not None and scene is None:
        raise InputError(f"--{preset} is for a scene file: a run that goes on has its settings already")
    return preset


def _run(scene: Path | None, resume: Path | None, overrides: list[str], preset: str | None, quiet: bool) -> Path:
    # Imported here, so that `--help` does not wait for Taichi and the readers to load.
    from modp_ti.config.scene_file import load_scene

    snapshot = None
    if resume is not None:
        from modp_ti.engine.snapshots import load_resumed

        config, snapshot = load_resumed(resume, scene, overrides, preset)
    else:
        assert scene is not None, "run() asks for one of them"
        config = load_scene(scene, overrides, preset)
    if config.output.exists() and not config.output.is_dir():
        raise InputError(f"{config.output}: output must be a folder, this is a file")

    from modp_ti.engine.session import run_scene

    return run_scene(config, progress_console(quiet), snapshot)


def _replay(recorded: Path, overrides: list[str], quiet: bool) -> Path:
    """Repeat a recorded session. Its output goes to a folder beside that of the recorded run, unless it is set."""
    from modp_ti.config.scene_file import scene_from_data
    from modp_ti.engine.recording import RecordedSession
    from modp_ti.engine.session import run_scene

    session = RecordedSession(recorded)
    beside = recorded.resolve().with_name(f"{recorded.resolve().name}-replayed")
    settings = {**session.settings, "output": str(beside)}
    return run_scene(scene_from_data(settings, str(recorded), overrides), progress_console(quiet), replayed=session)
