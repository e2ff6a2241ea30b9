"""The work of a task of a batch: maps one scene, from the last snapshot if there is one."""

from __future__ import annotations

import platform
import tempfile
from pathlib import Path
from typing import Any

from modp_ti.batch.finished import finished_metrics, is_stored
from modp_ti.config.scene_file import scene_from_data
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import appearing
from modp_ti.files.sole_use import sole_use
from modp_ti.files.storage import Storage, StorageError
from modp_ti.tasks import Report

__all__ = ["fetch_finished", "map_scene"]

# Folder of the finished run's files within the scene's storage.
OUTPUT = "output"


def map_scene(settings: dict[str, Any], report: Report) -> dict[str, Any]:
    """Map a scene and return the content of its `metrics.json`.

    A run that an earlier attempt has finished is not repeated, and one that it has begun continues from its last
    snapshot: that of the output folder or of `snapshot_store`, whichever is further. A snapshot that does not fit the
    settings is left aside. With `snapshot_store`, the output files are copied there as well.

    Args:
        settings: The scene's settings as plain data, with absolute paths.
        report: Called with the `StageProgress` of the run.

    Raises:
        InputError: If the input cannot be used.
    """
    # Imported here: the command line makes these tasks without loading Taichi.
    from modp_ti.engine.session import run_scene
    from modp_ti.engine.snapshots import fetch_snapshot
    from modp_ti.files.terminal import CleanConsole

    config = scene_from_data(settings, "the scene")
    console = CleanConsole(stderr=True)
    with sole_use(config.output):
        metrics = finished_metrics(config)
        if metrics is None:
            try:
                fetch_snapshot(config)
            except StorageError as error:
                console.print(f"note: {error}", highlight=False, soft_wrap=True, markup=False)
            run_scene(*_begun(config, console), watch=report)
            metrics = finished_metrics(config)
        if metrics is None:
            raise InputError(f"{config.output}: the run has left no metrics.json that can be read; run it again")
        if config.snapshot_store:
            try:
                Storage(config.snapshot_store).within(OUTPUT).put_folder(config.output)
            except StorageError as error:
                raise InputError(f"{error}; the map is in {config.output} on {platform.node()}") from None
    return metrics


def _begun(config: SceneConfig, console: Any) -> tuple[SceneConfig, Any, Any]:
    """Return settings, console and snapshot for `run_scene`; None for a snapshot if there is none that fits."""
    from modp_ti.engine.snapshots import Snapshot, continued
    from modp_ti.engine.snapshots.file import FILE

    file = config.output / FILE
    if not file.is_file():
        return config, console, None
    try:
        snapshot = Snapshot.read(file)
        return continued(config, snapshot), console, snapshot
    except InputError as error:
        console.print(f"note: begun anew: {error}", highlight=False, soft_wrap=True, markup=False)
        return config, console, None


def fetch_finished(config: SceneConfig) -> bool:
    """Copy the files of a finished run from `snapshot_store` to the output folder, unless it has them already.

    Returns:
        Whether the output folder now holds a finished run of these settings.

    Raises:
        InputError: If the storage cannot be read, or the output folder not be written.
    """
    if finished_metrics(config) is not None or not config.snapshot_store:
        return finished_metrics(config) is not None
    storage = Storage(config.snapshot_store).within(OUTPUT)
    with tempfile.TemporaryDirectory(prefix="modp-ti-batch-") as folder:
        if not is_stored(config, storage, Path(folder)):
            return False
    with appearing(config.output) as folder:
        storage.get_folder(folder)
    return finished_metrics(config) is not None
