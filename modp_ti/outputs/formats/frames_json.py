"""`frames.json`: facts about a run that later commands need and no other file contains."""

from __future__ import annotations

import json
import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from modp_ti.files import read_json
from modp_ti.files.atomic import replace_text
from modp_ti.files.errors import InputError

__all__ = ["FramesRecord", "read_frames", "write_frames"]


@dataclass(frozen=True)
class FramesRecord:
    """Content of `frames.json`.

    Attributes:
        near: Depth below which nothing is drawn [scene units].
        scene_depth: Median depth of the keyframes' views [scene units].
        keyframes: Ascending positions of the keyframes in trajectory.txt.
        held_out: Ascending positions of the held-out frames in trajectory.txt.
    """

    near: float
    scene_depth: float
    keyframes: list[int]
    held_out: list[int]


def write_frames(
    path: Path, near: float, scene_depth: float, keyframes: Collection[int], held_out: Collection[int]
) -> None:
    """Write the record. Numbers are written with enough digits to be read back exactly."""
    record = FramesRecord(float(near), float(scene_depth), sorted(keyframes), sorted(held_out))
    text = ",\n ".join(f'"{name}": {json.dumps(value)}' for name, value in vars(record).items())
    replace_text(path, f"{{{text}}}\n")


def read_frames(path: Path, count: int) -> FramesRecord:
    """Read the record of a run of `count` frames.

    Raises:
        InputError: If the file is damaged or does not fit `count`.
    """
    try:
        data = read_json(path, "of a finished run")
        record = FramesRecord(
            float(data["near"]), float(data["scene_depth"]), list(data["keyframes"]), list(data["held_out"])
        )
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as what a run says of its frames: {error!r:.80}") from None
    indices = [*record.keyframes, *record.held_out]
    if not (0 < record.near < math.inf and 0 < record.scene_depth < math.inf and record.keyframes):
        raise InputError(f"{path}: near and scene_depth must be positive, and keyframes must name some")
    if not all(type(index) is int and 0 <= index < count for index in indices):
        raise InputError(f"{path}: names frames beyond the {count} that trajectory.txt has")
    return record
