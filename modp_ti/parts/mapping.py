"""`map_in_parts`: maps the parts of a recording by the tasks of an engine, and merges their maps."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from rich.console import Console

from modp_ti.batch.batch import LOGS, Shares, run_batch
from modp_ti.batch.results import State
from modp_ti.batch.scenes import with_store
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import run_folder
from modp_ti.inputs.scene_paths import refuse_output_in_input
from modp_ti.inputs.trackers import open_tracker
from modp_ti.outputs.progress import ProgressLine
from modp_ti.parts.part_scenes import FOLDER, part_scenes
from modp_ti.tasks import open_engine

__all__ = ["map_in_parts"]


def map_in_parts(
    config: SceneConfig, engine: str = "local", address: str | None = None, console: Console | None = None
) -> Path:
    """Map a recording in the parts of its settings, and write its output folder as `run_scene` does.

    The parts are mapped to `parts/1`, `parts/2`, ... in the output folder. Parts that are finished, with these
    settings, are not mapped again.

    Args:
        config: The settings of the recording, with `parts`.
        engine: What carries out the runs of the parts: "local" for processes on this machine, "ray" for a Ray cluster.
        address: Address of the Ray cluster, see `open_engine`.
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
    with open_engine(engine, address, logs=folder / LOGS) as opened:
        results = run_batch(scenes, opened, folder, Shares(), console)
    failed = [result for result in results if result.state not in (State.finished, State.before)]
    if failed:
        raise InputError(f"{failed[0].name}: {failed[0].error}; the same command goes on with the parts that are left")
