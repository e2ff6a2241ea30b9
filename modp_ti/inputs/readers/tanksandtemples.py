"""Kind `tanksandtemples`: poses in a `.log` of Tanks and Temples or Redwood."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fields.geometry.se3 import inverse_se3
from modp_ti.files import LARGEST, input_lines
from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import checked_pose
from modp_ti.inputs.given_poses import found_file, replay_positions
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.reader import GivenPosesSettings
from modp_ti.inputs.replay import ReplayedTracker

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig

MOST_IMAGES = 1e9
BLOCK = 5  # lines of an image: three integers, and four rows of a matrix, camera to world


class TanksAndTemplesSettings(GivenPosesSettings):
    """The poses of Tanks and Temples."""

    places_panoramas: ClassVar[bool] = True

    kind: Literal["tanksandtemples"] = Field(
        default="tanksandtemples", description="a `.log` of Tanks and Temples or Redwood"
    )
    path: Path | None = Field(
        default=None, description="the file; empty: the only `*.log` in the images' folder or next to it"
    )

    def open(self, scene: SceneConfig, progress: Progress | None = None) -> ReplayedTracker:
        """Open the images that are registered in the file.

        The first of an image's three integers is its position among the images, from 0. A second integer of -1 means
        that the image has no pose.
        """
        file = _found(self.path, scene.source.require_path())
        return replay_positions(file, _read_log(file), scene.source, self, progress)


def _read_log(file: Path) -> dict[int, NDArray[np.float64]]:
    """Read T_camera_world (4, 4) by position. Raises InputError, with the line, if the file is malformed."""
    poses: dict[int, NDArray[np.float64]] = {}
    block: list[list[float]] = []
    for number, line in enumerate(input_lines(file, " (tracker.path)"), 1):
        words = line.split()
        if not words:
            continue
        where = f"{file}:{number}"
        block.append(_numbers(words, 4 if block else 3, where))
        if len(block) < BLOCK:
            continue
        (position, registered, _), *matrix = block
        block = []
        if position != int(position) or not 0 <= position < MOST_IMAGES:
            raise InputError(f"{where}: the block above does not begin with the position of an image, from 0")
        if int(position) in poses:
            raise InputError(f"{where}: image {int(position)} has a pose already")
        if registered != -1:
            poses[int(position)] = inverse_se3(checked_pose(np.array(matrix), where))
    if block or not poses:
        raise InputError(f"{file}: " + ("is cut off: its last block is not complete" if block else "holds no pose"))
    return poses


def _numbers(words: list[str], count: int, where: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not all(abs(value) <= LARGEST for value in values):
        raise InputError(f"{where}: must be {count} finite numbers: three integers and a 4x4 matrix per image")
    return values


def _found(given: Path | None, place: Path) -> Path:
    folders = [place, place.parent] if given is None else [given]
    if given is not None and not given.is_dir():
        return found_file(given, [], "a .log of Tanks and Temples")
    for folder in folders:
        found = sorted(folder.glob("*.log")) if folder.is_dir() else []
        if len(found) > 1:
            raise InputError(f"{folder}: holds {len(found)} files .log: name one of them in tracker.path")
        if found:
            return found[0]
    raise InputError(f"no .log in {' or '.join(map(str, folders))}: set tracker.path to that of Tanks and Temples")
