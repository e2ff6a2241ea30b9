"""Recognises the finished run of a scene by what it left in the output folder or its storage."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from modp_ti.config.keys import differing_keys
from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.files import read_json
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import appearing, require_whole
from modp_ti.files.storage import Storage

__all__ = ["OUTPUT", "fetch_finished", "finished_metrics"]

# Settings on which neither the map nor the other output files depend, but for the device, in the last digits.
FREE = ("output", "device", "threads", "snapshot_every", "snapshot_store", "source.prefetch", "view")
# Folder of the finished run's files within the scene's storage.
OUTPUT = "output"
METRICS, SETTINGS = "metrics.json", "config.yaml"


def finished_metrics(config: SceneConfig) -> dict[str, Any] | None:
    """Return the metrics of a finished run with these settings in `config.output`, None if there is none.

    A run with further maps (`tracker.maps: all`) is finished when all of them are.
    """
    try:
        require_whole(config.output)
        metrics = read_json(config.output / METRICS, METRICS)
        written = load_scene(config.output / SETTINGS)
        further = int(metrics.get("further_maps", 0))
    except (InputError, AttributeError, TypeError, ValueError):
        return None
    if not _same(written, config):
        return None
    maps = [config.of_map(place).output / METRICS for place in range(2, 2 + further)]
    return metrics if all(file.is_file() for file in maps) else None


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
    if not _is_stored(config, storage):
        return False
    with appearing(config.output) as folder:
        storage.get_folder(folder)
    return finished_metrics(config) is not None


def _is_stored(config: SceneConfig, storage: Storage) -> bool:
    """Whether a storage holds a finished run with these settings. Raises StorageError if it cannot be read."""
    with tempfile.TemporaryDirectory(prefix="modp-ti-batch-") as folder:
        file = Path(folder) / SETTINGS
        if not storage.has(METRICS) or not storage.get(SETTINGS, file):
            return False
        try:
            return _same(load_scene(file), config)
        except InputError:
            return False


def _same(written: SceneConfig, config: SceneConfig) -> bool:
    scale = written.source.scale
    if scale != "auto":  # the run's number, which `auto` in the scene file became
        config = config.resolved(scale)
    return not differing_keys(written.model_dump(mode="json"), config.model_dump(mode="json"), FREE)
