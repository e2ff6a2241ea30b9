"""Kind `matrices`: text with a matrix, camera to world, per line, in the order of the images."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from modp_ti.files import input_lines
from modp_ti.files.trajectory import read_number_rows
from modp_ti.inputs.capture import opencv_pose
from modp_ti.inputs.posed_recording import PosedRecording
from modp_ti.inputs.reader import GivenPosesSettings

MEANING = "a 3x4 or 4x4 matrix, camera to world, row by row"


class MatricesSettings(GivenPosesSettings):
    """Text with a 3x4 or 4x4 matrix, camera to world, per line."""

    places_panoramas: ClassVar[bool] = True

    kind: Literal["matrices"] = "matrices"
    path: Path | None = Field(
        default=None,
        description="the file or its folder; empty: `poses.txt` or `traj.txt` in the images' folder or next to it",
    )

    def add_poses(self, recording: PosedRecording) -> None:
        """Give image n of the source the matrix of line n, from 0."""
        file = self.found(
            recording.source, ("poses.txt", "traj.txt"), "a file with a matrix, camera to world, per line"
        )
        lines = (line.partition("#")[0].replace(",", " ").split() for line in input_lines(file, " (tracker.path)"))
        columns = 16 if len(next(filter(None, lines), [])) == 16 else 12
        rows = read_number_rows(file, columns, MEANING)
        poses = {n: opencv_pose(row, rows.where(n)) for n, row in enumerate(rows.values)}
        self.give_by_number(recording, file, poses)
