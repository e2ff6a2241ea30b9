"""Recognises the finished run of a scene by what it left in the output folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from modp_ti.config.keys import differing_keys
from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.files import read_json
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import require_whole
from modp_ti.files.storage import Storage

__all__ = ["finished_metrics", "is_stored"]

# Settings on which neither the map nor the other output files depend, but for the device, in the last digits.
FREE = ("output", "device", "threads", "snapshot_every", "snapshot_store", "source.prefetch", "view")
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


def is_stored(config: SceneConfig, storage: Storage, folder: Path) -> bool:
    """Whether a storage holds a finished run with these settings.

    Args:
        config: The scene's settings.
        storage: Where its output files may have been copied to.
        folder: An existing folder for temporary files.

    Raises:
        StorageError: If the storage cannot be read.
    """
    if not storage.has(METRICS) or not storage.get(SETTINGS, folder / SETTINGS):
        return False
    try:
        return _same(load_scene(folder / SETTINGS), config)
    except InputError:
        return False


def _same(written: SceneConfig, config: SceneConfig) -> bool:
    scale = written.source.scale
    if scale != "auto":  # the run's number, which `auto` in the scene file became
        config = config.resolved(scale)
    return not differing_keys(written.model_dump(mode="json"), config.model_dump(mode="json"), FREE)
