"""`modp-ti run --parts`: maps the parts of a recording by tasks, and merges them into the map of a run."""

from __future__ import annotations

import shutil
from contextlib import closing
from pathlib import Path

from rich.console import Console

from modp_ti.config.scene_paths import refuse_output_in_input
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.parts import FOLDER, part_config, parts_of
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import appearing, run_folder
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.protocol import Tracker
from modp_ti.many.batch import LOGS, Scene, for_a_task, run_batch, with_store
from modp_ti.many.pool import open_pool
from modp_ti.outputs.progress import ProgressLine


def part_scenes(tracker: Tracker, config: SceneConfig) -> list[Scene]:
    """Return the parts of a recording as the scenes of a batch.

    Args:
        tracker: The opened tracker of the whole recording. A model that it has made is given to the parts.
        config: The settings of the whole recording.

    Raises:
        InputError: If the recording is too short for so many parts.
    """
    parts = parts_of(tracker, config)
    runs = [(f"part-{part.number}", for_a_task(part_config(config, part))) for part in parts]
    scenes = [Scene(name, run.output, run) for name, run in runs]
    if config.tracker.kind == "sfm":
        for scene in scenes:
            assert scene.config is not None
            with appearing(scene.config.output, ("sfm",)) as staged:
                shutil.copytree(config.output / "sfm", staged / "sfm")
    return scenes


def map_in_parts(
    config: SceneConfig, engine: str = "local", address: str | None = None, console: Console | None = None
) -> Path:
    """Map a recording in the parts of its settings, and write its output folder as `run_scene` does.

    The parts are mapped to `parts/1`, `parts/2`, ... in the output folder. Parts that are finished, with these
    settings, are not mapped again.

    Args:
        config: The settings of the recording, with `parts`.
        engine: What carries out the runs of the parts: "local" for processes on this machine, "ray" for a Ray cluster.
        address: Address of the Ray cluster, see `RayPool`.
        console: Receives progress and notes, None for no output.

    Returns:
        The output folder.

    Raises:
        InputError: If the input cannot be used, or a part cannot be mapped.
        KeyboardInterrupt: After Ctrl-C, when the parts have saved what they had.
    """
    console = console or Console(quiet=True)
    refuse_output_in_input(config)
    with run_folder(config.output):
        _map_parts(config, engine, address, console)
        from modp_ti.engine.session import run_scene  # here, so that the parts' processes have the memory until then

        return run_scene(config, console)


def _map_parts(config: SceneConfig, engine: str, address: str | None, console: Console) -> None:
    """Map the parts that are not mapped."""
    with closing(open_tracker(config, ProgressLine(console).prepare)) as tracker:
        scenes = part_scenes(tracker, config)
    if config.snapshot_store:
        scenes = with_store(scenes, config.snapshot_store)
    folder = config.output / FOLDER
    with open_pool(engine, folder / LOGS, address) as pool:
        results = run_batch(scenes, pool, folder, console=console)
    failed = [result for result in results if not result.state.is_done]
    if failed:
        raise InputError(f"{failed[0].name}: {failed[0].error}; the same command maps the parts that are left")
