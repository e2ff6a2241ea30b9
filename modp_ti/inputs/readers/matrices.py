"""Kind `matrices`: text with a matrix, camera to world, per line, in the order of the images."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import Field

from fields.geometry.se3 import inverse_se3
from modp_ti.files import input_lines
from modp_ti.files.number_rows import NumberRows, read_number_rows
from modp_ti.files.trajectory import checked_pose
from modp_ti.inputs.given_poses import found_file, replay_positions
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.reader import GivenPosesSettings
from modp_ti.inputs.replay import ReplayedTracker

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig

NAMES = ("poses.txt", "traj.txt")


class MatricesSettings(GivenPosesSettings):
    """Matrices, one per line."""

    places_panoramas: ClassVar[bool] = True

    kind: Literal["matrices"] = Field(
        default="matrices", description="text with a 3x4 or 4x4 matrix, camera to world, per line"
    )
    path: Path | None = Field(
        default=None,
        description="the file or its folder; empty: `poses.txt` or `traj.txt` in the images' folder or next to it",
    )

    def open(self, scene: SceneConfig, progress: Progress | None = None) -> ReplayedTracker:
        """Open the images that have a line. Line n, from 0, belongs to image n of the source."""
        place = scene.source.require_path()
        guesses = [folder / name for folder in (place, place.parent) for name in NAMES]
        file = found_file(self.path, guesses, "a file with a matrix, camera to world, per line")
        rows, poses = _read_matrices(file), {}
        for n, row in enumerate(rows.values):
            matrix = np.vstack([row.reshape(-1, 4)[:3], [0.0, 0.0, 0.0, 1.0] if len(row) == 12 else row[12:]])
            poses[n] = inverse_se3(checked_pose(matrix, rows.where(n)))
        return replay_positions(file, poses, scene.source, self, progress)


def _read_matrices(file: Path) -> NumberRows:
    """Read rows of 16 numbers if the first has as many, otherwise of 12."""
    meaning = "a 3x4 or 4x4 matrix, camera to world, row by row"
    lines = input_lines(file, " (tracker.path)")
    words = next(filter(None, (line.partition("#")[0].replace(",", " ").split() for line in lines)), [])
    others = {8: "; a time, a position and a quaternion are tracker.kind: tum"}
    return read_number_rows(file, 16 if len(words) == 16 else 12, meaning, others=others)
