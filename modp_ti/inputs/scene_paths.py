"""The paths that a scene reads, which its output folder must not touch."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from pydantic import BaseModel

from modp_ti.config.settings import SceneConfig
from modp_ti.config.tracker_settings import SocketSettings
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import is_run_folder

__all__ = ["refuse_output_in_input"]

# Folders next to the images in which trackers look for their files if `tracker.path` is empty.
SEARCHED = ("sparse", "poses", "slam", "trajectory", "point_cloud", "orb_point_clouds")
# Settings whose folder holds nothing else than what they name.
OF_ITS_OWN = ("source.path", "source.masks", "onto")
REMEDY = "name a folder of its own (output)"


def refuse_output_in_input(config: SceneConfig, base: Path | None = None, replayed: Path | None = None) -> None:
    """Raise InputError if the output folder is, holds or lies in what the scene reads.

    It may lie in a folder that only is the root of what is read there, such as a data set or a capture, the scene's own
    folder, or that of a model, if it is new, empty or of an earlier run. Readers of images leave folders of runs out.

    Args:
        config: The settings of the scene.
        base: Folder that relative paths of the scene are relative to, if it is known. What holds it may hold the output
            as well.
        replayed: A recorded session that the run repeats.
    """
    output = config.output
    read = [*_paths(config, ""), *([("--replay", replayed)] if replayed is not None else [])]
    if isinstance(config.source.stream, str):
        read.append(("source.stream", Path(config.source.stream)))
    images = config.source.path
    if images is not None and dict(read).get("tracker.path") is None:
        read += [("tracker.path", place) for name in SEARCHED if (place := images.parent / name).is_dir()]
    for setting, path in read:
        if _is_within(path, output):
            raise InputError(f"{output}: output is or holds {path} ({setting}), which the scene reads: {REMEDY}")
        if not _is_within(output, path):
            continue
        foreign = output.is_dir() and os.listdir(output) and not is_run_folder(output)
        inside = setting in OF_ITS_OWN and base is not None and not _is_within(base, path)
        if foreign or (inside and (setting != "source.path" or _holds_images_alone(config))):
            raise InputError(f"{output}: output lies in {path} ({setting}), which the scene reads: {REMEDY}")


def _paths(model: BaseModel, start: str) -> Iterator[tuple[str, Path]]:
    """Yield the settings that name something to read, and what they name."""
    for name, value in model:
        if isinstance(value, BaseModel):
            yield from _paths(value, f"{start}{name}.")
        elif isinstance(value, Path) and name != "output" and not isinstance(model, SocketSettings):
            yield f"{start}{name}", value


def _holds_images_alone(config: SceneConfig) -> bool:
    """Whether the source is a folder of images, all of which are read, those of its subfolders included."""
    from modp_ti.inputs.opening import recognised_kind  # here, as readers of all kinds come with it

    source = config.source
    return (recognised_kind(source.require_path()) if source.kind == "auto" else source.kind) == "images"


def _is_within(inner: Path, outer: Path) -> bool:
    """Whether a path is another one or lies in it, by whatever names and links they are reached."""
    inner, outer = Path(os.path.realpath(inner)), Path(os.path.realpath(outer))
    return any(place == outer or _is_same(place, outer) for place in (inner, *inner.parents))


def _is_same(one: Path, other: Path) -> bool:
    try:
        return os.path.samefile(one, other)
    except OSError:  # one of them does not exist
        return False
