"""`Scene`: a recording of a batch with its settings, read from what the user named."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from modp_ti.config.settings import SceneConfig, ViewSettings
from modp_ti.files.errors import InputError
from modp_ti.files.urls import actual_url, shown_url
from modp_ti.inputs.bare_recording import base_of, named_scene
from modp_ti.inputs.scene_paths import refuse_output_in_input
from modp_ti.many.pool import Resources

__all__ = ["SNAPSHOT_EVERY", "Scene", "for_a_task", "read_scenes", "with_resources", "with_store"]

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


def with_resources(config: SceneConfig, resources: Resources) -> SceneConfig:
    """Return a scene's settings for a process that has these resources: as many threads as cores, no GPU without one.

    A number of threads that the scene sets is kept.
    """
    threads = config.threads or max(1, int(resources.cpus))
    return config.model_copy(update={"threads": threads, "device": config.device if resources.gpus else "cpu"})


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
