"""`modp-ti run`: maps a scene file, a recording or a stream, as `python -m modp_ti.run` does."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modp_ti.commands.shared import (
    Address,
    AsJson,
    Best,
    Fast,
    Overrides,
    Quiet,
    Where,
    chosen_preset,
    examples,
    outcome,
    progress_console,
)
from modp_ti.files.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from modp_ti.config.settings import SceneConfig
    from modp_ti.engine.snapshot import Snapshot

EXAMPLES = examples(
    "modp-ti run scene.yaml",
    "modp-ti run scene.yaml --fast   (a first look; --best for a map to keep)",
    "modp-ti run scene.yaml --minutes 5   (the best map of so much time)",
    "modp-ti run scene.yaml --set source.scale=0.5 --set refine.steps=3000",
    "modp-ti run room.mp4 --fast   (or a folder of images; the map is in out/room)",
    "modp-ti run --stream 0 --view   (a camera; modp-ti cameras lists them)",
    "modp-ti run scene.yaml --set mode=offline --set output=out/3dgs",
    "modp-ti run second.yaml --onto OUT   (go on with a finished map)",
    "modp-ti run scene.yaml --parts 4   (by several processes; docs/scale.md)",
    "modp-ti run scene.yaml --set snapshot_every=50",
    "modp-ti run --resume OUT   (after a crash or Ctrl-C)",
    "modp-ti run --replay OUT   (repeat a recorded realtime or timed run)",
    "modp-ti run scene.yaml --quiet --json > result.json",
)


def run(
    scene: Annotated[
        Path | None,
        typer.Argument(
            metavar="SCENE",
            help="scene file (YAML), whose paths are relative to it; or a video or a folder of images, which is mapped "
            "to out/NAME; not needed with --stream or --resume",
        ),
    ] = None,
    set_: Overrides = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            "--resume", metavar="OUT", help="go on with the run whose output folder this is, from its snapshot"
        ),
    ] = None,
    stream: Annotated[
        str | None,
        typer.Option(
            "--stream", metavar="CAMERA", help="instead of SCENE: map a camera (number or device) or a URL to out/NAME"
        ),
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option(
            "--replay", metavar="OUT", help="repeat the recorded run whose output folder this is, from its session.zip"
        ),
    ] = None,
    onto: Annotated[
        Path | None,
        typer.Option(
            "--onto", metavar="OUT", help="go on with the finished map of this output folder (docs/second_visit.md)"
        ),
    ] = None,
    parts: Annotated[
        int | None,
        typer.Option(
            "--parts", min=2, help="map the recording in so many parts, each by a task of its own, and merge their maps"
        ),
    ] = None,
    engine: Annotated[
        Where | None, typer.Option(help="of `--parts`: `local`, processes on this machine; `ray`, a Ray cluster")
    ] = None,
    address: Address = None,
    minutes: Annotated[
        float | None,
        typer.Option("--minutes", help="the best map that so many minutes give on this machine, from now to its files"),
    ] = None,
    fast: Fast = False,
    best: Best = False,
    force: Annotated[bool, typer.Option("--force", help="map even if the poses do not fit the images")] = False,
    view: Annotated[bool, typer.Option("--view", help="serve a web page that shows the map as it grows")] = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
    task: Annotated[bool, typer.Option("--task", hidden=True)] = False,  # of a batch: settings from standard input
    more: Annotated[list[str] | None, typer.Argument(metavar="KEY=VALUE", hidden=True)] = None,
) -> None:
    """Map a recording or a stream while its frames arrive, and write splats, poses, metrics, pictures and a report."""
    began = time.perf_counter()
    if scene is not None and "=" in scene.name and not scene.exists():  # `--stream 0 --set seed=1 source.stop=600`
        scene, more = None, [str(scene), *(more or [])]
    sources = [source for source in (scene, stream, resume, replay) if source is not None]
    if not sources and not task:
        raise typer.BadParameter(
            "name a scene file, a video or a folder of images, a camera (--stream 0), or the output folder of a run to "
            "go on with (--resume OUT)"
        )
    with outcome(as_json) as result:
        if scene is not None and any("=" not in word for word in more or []):
            raise InputError("one recording at a time: `modp-ti batch` maps several; of pictures, name their folder")
        if len(sources) > 1 and (stream is not None or replay is not None):
            raise InputError("--stream and --replay need no scene file and no --resume: give one of them")
        settled = {"--onto": onto, "--parts": parts, "--minutes": minutes} | (
            {} if scene else {"--fast": fast, "--best": best}
        )
        for option, value in settled.items():
            if value and (resume is not None or replay is not None):
                raise InputError(f"{option} is for a scene: a run that is resumed or repeated has its settings already")
        if minutes is not None and (fast or best):
            raise InputError("--minutes sets the steps by the clock: give it without --fast and --best")
        overrides = [*(["view.enabled=true"] * view), *(["force=true"] * force), *(set_ or []), *(more or [])]
        if onto is not None:
            overrides.append(f"onto={json.dumps(str(onto.expanduser().resolve()), ensure_ascii=False)}")
        if parts is not None:
            overrides.append(f"parts={parts}")
        if minutes is not None:
            overrides.append(f"minutes={minutes}")
        preset, console = chosen_preset(fast, best), progress_console(quiet)
        if task:
            from modp_ti.many.task import carry_out

            folder = carry_out(console)
        elif replay is not None:
            folder = _replay(replay, overrides, console)
        else:
            config, snapshot = _settings(scene, stream, resume, overrides, preset, console)
            folder = _map(config, snapshot, engine, address, console, began)
            if resume is not None:
                from modp_ti.engine.resume import discard

                discard(folder)
        result.text = f"written to {folder}"
        if as_json:
            metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
            result.data = {"output": str(folder), "metrics": metrics}


def _settings(
    scene: Path | None,
    stream: str | None,
    resume: Path | None,
    overrides: list[str],
    preset: str | None,
    console: Console,
) -> tuple[SceneConfig, Snapshot | None]:
    """Return the settings of a run, and the snapshot that it resumes from, if any."""
    # Imported here, so that `--help` does not wait for Taichi and the readers to load.
    from modp_ti.config.bare_recording import base_of, is_recording, named_scene, streamed_scene
    from modp_ti.config.scene_paths import refuse_output_in_input
    from modp_ti.files.run_folder import require_usable
    from modp_ti.outputs.progress import ProgressLine

    if resume is not None:
        from modp_ti.engine.resume import load_resumed

        if scene is not None and is_recording(scene):
            raise InputError(f"{scene}: --resume has the recording already; leave it out")
        return load_resumed(resume, scene, overrides, preset)
    if stream is not None:
        config = streamed_scene(stream, overrides, preset)
    else:
        assert scene is not None, "run() asks for one of them"
        config = named_scene(scene, overrides, preset, say=ProgressLine(console).note)
    refuse_output_in_input(config, Path.cwd() if scene is None else base_of(scene))
    require_usable(config.output)  # once more in the run: here, before Taichi is loaded
    return config, None


def _map(
    config: SceneConfig,
    snapshot: Snapshot | None,
    engine: Where | None,
    address: str | None,
    console: Console,
    began: float,
) -> Path:
    """Map in this process, or in parts. Returns the output folder."""
    if config.parts is not None:
        from modp_ti.many.parts import map_in_parts

        return map_in_parts(config, engine or "local", address, console)
    if engine is not None or address is not None:
        raise InputError("--engine and --address are for --parts, whose tasks they carry out")
    from modp_ti.engine.session import run_scene

    return run_scene(config, console, snapshot, began=began)


def _replay(recorded: Path, overrides: list[str], console: Console) -> Path:
    """Repeat a recorded session. Its output goes to a folder next to that of the recorded run, unless it is set."""
    from modp_ti.config.scene_file import scene_from_data
    from modp_ti.engine.recording import RecordedSession
    from modp_ti.engine.session import run_scene

    session = RecordedSession(recorded)
    target = recorded.resolve().with_name(f"{recorded.resolve().name}-replayed")
    settings = {**session.settings, "output": str(target)}
    return run_scene(scene_from_data(settings, str(recorded), overrides), console, replayed=session)
