"""Kind `tanksandtemples`: poses in a `.log` of Tanks and Temples or Redwood."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from numpy.typing import NDArray
from pydantic import Field

from modp_ti.files import LARGEST, input_lines
from modp_ti.files.errors import InputError
from modp_ti.inputs.capture import opencv_pose
from modp_ti.inputs.posed_recording import PosedRecording
from modp_ti.inputs.reader import GivenPosesSettings

BLOCK = 5  # lines of an image: three integers, and four rows of a matrix, camera to world


class TanksAndTemplesSettings(GivenPosesSettings):
    """A `.log` of Tanks and Temples or Redwood."""

    places_panoramas: ClassVar[bool] = True

    kind: Literal["tanksandtemples"] = "tanksandtemples"
    path: Path | None = Field(
        default=None, description="the file; empty: the only `*.log` in the images' folder or next to it"
    )

    def add_poses(self, recording: PosedRecording) -> None:
        """Give the registered images their poses.

        The first of an image's three integers is its position among the images, from 0. A second integer of -1 means
        that the image has no pose.
        """
        file = self.found(recording.source, ("*.log",), "a .log of Tanks and Temples")
        poses: dict[int, NDArray] = {}
        lines = ((number, line.split()) for number, line in enumerate(input_lines(file, " (tracker.path)"), 1))
        block: list[list[float]] = []
        for number, words in lines:
            if not words:
                continue
            block.append(_numbers(words, 4 if block else 3, f"{file}:{number}"))
            if len(block) < BLOCK:
                continue
            (position, registered, _), *matrix = block
            block = []
            if position != int(position) or position < 0 or int(position) in poses:
                raise InputError(f"{file}:{number}: the block above begins with no position of an image, or one again")
            if registered != -1:
                poses[int(position)] = opencv_pose(matrix, f"{file}:{number}")
        if block or not poses:
            raise InputError(f"{file}: " + ("is cut off: its last block is not complete" if block else "holds no pose"))
        self.give_by_number(recording, file, poses)


def _numbers(words: list[str], count: int, where: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not all(abs(value) <= LARGEST for value in values):
        raise InputError(f"{where}: must be {count} finite numbers: three integers and a 4x4 matrix per image")
    return values
