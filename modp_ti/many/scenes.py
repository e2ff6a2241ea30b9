"""`Scene`: a recording of a batch with its settings, and how its finished run is recognised by what that has left."""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from modp_ti.config.keys import differing_keys
from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig, ViewSettings
from modp_ti.files import read_json
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import appearing, require_whole
from modp_ti.files.storage import Storage
from modp_ti.files.urls import actual_url, shown_url
from modp_ti.inputs.bare_recording import base_of, named_scene
from modp_ti.inputs.scene_paths import refuse_output_in_input

# Settings on which neither the map nor the other output files depend, but for the device, in the last digits.
FREE = ("output", "device", "threads", "snapshot_every", "snapshot_store", "source.prefetch", "view")
# Folder of the finished run's files within the scene's storage.
OUTPUT = "output"
METRICS, SETTINGS = "metrics.json", "config.yaml"
# Frames between snapshots where the scene does not set `snapshot_every`.
SNAPSHOT_EVERY = 50


@dataclass(frozen=True)
class Scene:
    """A recording of a batch.

    Attributes:
        name: Unique name in the batch: that of its output folder or, if it cannot be read, of what the user named.
        given: What the user named.
        config: Its settings, None if they cannot be read.
        error: Otherwise one line that says why.
    """

    name: str
    given: Path
    config: SceneConfig | None = None
    error: str = ""


def read_scenes(given: Iterable[Path], overrides: Sequence[str] = (), preset: str | None = None) -> list[Scene]:
    """Read the settings of scene files and recordings. One that cannot be read does not hinder the others.

    Args:
        given: Scene files, videos and folders of images. One that is named twice counts once.
        overrides: As for `load_scene`, for every scene.
        preset: As for `load_scene`, for every scene.

    Returns:
        The scenes, in order. No two write to the same folder.
    """
    scenes: list[Scene] = []
    outputs: dict[Path, Path] = {}  # what the user named, by the output folder
    for path in {path.expanduser().resolve(): path for path in given}.values():
        try:
            config = _read(path, overrides, preset, list(outputs))
            if config.output in outputs:
                other = outputs[config.output]
                raise InputError(f"{path}: {config.output} is the output folder of {other} too: set another one")
        except InputError as error:
            scenes.append(Scene(_unique(Path(shown_url(str(path))).name or str(path), scenes), path, error=str(error)))
            continue
        outputs[config.output] = path
        scenes.append(Scene(_unique(config.output.name, scenes), path, config))
    return scenes


def _read(path: Path, overrides: Sequence[str], preset: str | None, taken: list[Path]) -> SceneConfig:
    config = named_scene(path, overrides, preset, taken)
    refuse_output_in_input(config, base_of(path))
    if config.is_live:
        raise InputError(f"{path}: a live source has no place in a batch: map it with `modp-ti run`")
    if config.parts is not None:
        raise InputError(f"{path}: parts are mapped by tasks of their own: map it with `modp-ti run`, or remove parts")
    return for_a_task(config)


def for_a_task(config: SceneConfig) -> SceneConfig:
    """Return a scene's settings for a run in a process that may be lost, and that nobody watches."""
    every = config.snapshot_every
    if every is None and config.can_be_resumed:
        every = SNAPSHOT_EVERY
    return config.model_copy(update={"snapshot_every": every, "view": ViewSettings()})


def _unique(name: str, others: Sequence[Scene]) -> str:
    taken = {scene.name for scene in others}
    return next(choice for number in range(1, len(taken) + 2) if (choice := _numbered(name, number)) not in taken)


def _numbered(name: str, number: int) -> str:
    return name if number == 1 else f"{name}-{number}"


def with_store(scenes: Iterable[Scene], url: str) -> list[Scene]:
    """Return scenes whose snapshots are copied to folders of their own below a URL.

    The folder's name ends with a checksum of the output folder, so that it does not depend on the other scenes.
    """
    url, stored = actual_url(url), []
    for scene in scenes:
        if scene.config is not None:
            output = scene.config.output
            own = f"{url.rstrip('/')}/{output.name}-{zlib.crc32(str(output).encode()):08x}"
            scene = replace(scene, config=scene.config.model_copy(update={"snapshot_store": own}))
        stored.append(scene)
    return stored


# ---- finished runs --------------------------------------------------------------------------------------------------


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
