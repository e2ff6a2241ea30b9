"""The paths that a scene reads, which its output folder must not touch."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel

from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import is_run_folder
from modp_ti.inputs.opening import recognised_kind
from modp_ti.inputs.readers.socket import SocketSettings

# Folders next to the images in which trackers look for their files if `tracker.path` is empty.
SEARCHED = ("sparse", "poses", "slam", "trajectory", "point_cloud", "orb_point_clouds")


def refuse_output_in_input(config: SceneConfig, base: Path | None = None, replayed: Path | None = None) -> None:
    """Raise InputError if the output folder is, holds or lies in what the scene reads.

    In a folder of which a scene reads certain files, such as that of a data set, a capture or a model, it may lie if it
    is new, empty or of an earlier run. In a folder of images, masks, or an earlier map it may only lie if that folder
    holds the scene too: readers of images leave the folders of runs out.

    Args:
        config: The settings of the scene.
        base: Folder that relative paths of the scene are relative to; None if it is not known.
        replayed: A recorded session that the run repeats.
    """
    output, source = config.output, config.source
    read = [*_paths(config, ""), *([("--replay", replayed)] if replayed is not None else [])]
    if isinstance(source.stream, str):
        read.append(("source.stream", Path(source.stream)))
    if source.path is not None and "tracker.path" not in dict(read):
        read += [("tracker.path", place) for name in SEARCHED if (place := source.path.parent / name).is_dir()]
    for setting, path in read:
        how = None
        if _is_within(path, output):
            how = "is or holds"
        elif _is_within(output, path) and (
            (os.path.isdir(output) and os.listdir(output) and not is_run_folder(output))
            or (base is not None and not _is_within(base, path) and _is_read_whole(setting, config))
        ):
            how = "lies in"
        if how is not None:
            raise InputError(
                f"{output}: output {how} {path} ({setting}), which the scene reads: name a folder of its own (output)"
            )


def _paths(model: BaseModel, start: str) -> Iterator[tuple[str, Path]]:
    """Yield the settings that name something to read, and what they name."""
    for name, value in model:
        if isinstance(value, BaseModel):
            yield from _paths(value, f"{start}{name}.")
        elif isinstance(value, Path) and name != "output" and not isinstance(model, SocketSettings):
            yield f"{start}{name}", value


def _is_read_whole(setting: str, config: SceneConfig) -> bool:
    source = config.source
    if setting == "source.path" and source.path is not None:
        return (recognised_kind(source.path) if source.kind == "auto" else source.kind) == "images"
    return setting in ("source.masks", "onto")


def _is_within(inner: Path, outer: Path) -> bool:
    """Whether a path is another one or lies in it, by whatever names and links they are reached."""
    inner, outer = Path(os.path.realpath(inner)), Path(os.path.realpath(outer))
    for place in (inner, *inner.parents):
        with suppress(OSError):  # one of them does not exist
            if place == outer or os.path.samefile(place, outer):
                return True
    return False
