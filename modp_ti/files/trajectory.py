"""Tables of numbers and poses in text files: lines of numbers, trajectories in TUM format, quaternions and matrices."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_poses, matrices_from_unit_quaternions
from modp_ti.files import LARGEST, input_lines
from modp_ti.files.errors import InputError

FARTHEST = 1e12
"""Largest valid coordinate [scene units]. Squared coordinates must fit the map's float32."""

# What rows of so many columns are, for error messages.
FORMS = {8: "; a time, a position and a quaternion are tracker.kind: tum"}
FORMS |= dict.fromkeys((12, 16), "; a matrix in each line is tracker.kind: matrices")

# Largest deviation of a quaternion's length from 1. Rounding in text files stays below it.
MAX_LENGTH_ERROR = 1e-2
# Largest deviation of R^T R from the identity. Rounding in text files stays below it.
MAX_ROTATION_DEFECT = 1e-2


@dataclass(frozen=True)
class NumberRows:
    """The rows of a text table.

    Attributes:
        path: The file.
        values: (N, columns).
        lines: (N,) line of each row in the file, from 1.
        left_out: Number of rows that were skipped because they contain NaN or Inf, or are lost.
    """

    path: Path
    values: NDArray[np.float64]
    lines: NDArray[np.int64]
    left_out: int = 0

    def __len__(self) -> int:
        return len(self.values)

    def where(self, row: int) -> str:
        """File and line of a row, for messages."""
        return f"{self.path}:{self.lines[row]}"


def read_number_rows(
    path: Path,
    columns: int,
    meaning: str,
    setting: str = "tracker.path",
    more: bool = False,
    few: float = 0.0,
    least: int = 1,
    quaternion: slice | None = None,
    text: Iterable[str] | None = None,
) -> NumberRows:
    """Read a text table whose rows have `columns` finite numbers each.

    Args:
        path: The file.
        columns: Numbers per row.
        meaning: The columns in words, for error messages.
        setting: The configuration key that names the file, for error messages.
        more: Accept and ignore further columns.
        few: Largest share of the rows that may contain NaN or Inf; these rows are skipped.
        least: Least number of rows, 0 or 1.
        quaternion: Where a row has a quaternion; rows in which it is zero are skipped as those with NaN are.
        text: The lines of the file, where it lies in an archive.

    Raises:
        InputError: With file and line, if a row has another number of columns, text, too many rows contain NaN or Inf,
            or a number exceeds `LARGEST`; also if the file cannot be read or has no rows.
    """
    values, lines = array("d"), array("q")
    bad: list[int] = []
    for number, line in enumerate(input_lines(path, f" ({setting})") if text is None else text, start=1):
        words = line.split("#", 1)[0].replace(",", " ").split()
        if not words:
            continue
        if len(words) < columns or (len(words) > columns and not more):
            kind = FORMS.get(len(words), "")
            raise InputError(f"{path}:{number}: holds {len(words)} columns instead of {columns}: {meaning}{kind}")
        try:
            row = [float(word) for word in words[:columns]]
        except ValueError:
            raise InputError(f"{path}:{number}: not a row of numbers: {meaning}") from None
        if not all(map(math.isfinite, row)) or (quaternion is not None and not any(row[quaternion])):
            bad.append(number)
            continue
        if max(map(abs, row)) > LARGEST:
            raise InputError(f"{path}:{number}: holds a number beyond {LARGEST:g}; the file is damaged")
        values.extend(row)
        lines.append(number)
    if len(bad) > few * (len(lines) + len(bad)):
        raise InputError(f"{path}:{bad[0]}: holds NaN or infinite numbers, or a quaternion of zeros; take the line out")
    if len(lines) < least:
        raise InputError(f"{path}: holds no row of {meaning} ({setting})")
    rows = np.frombuffer(values).reshape(-1, columns)
    return NumberRows(path, rows, np.frombuffer(lines, dtype=np.int64), len(bad))


def read_tum_rows(path: Path, setting: str = "tracker.path", few: float = 0.0, least: int = 1) -> NumberRows:
    """Read the lines `time tx ty tz qx qy qz qw` of a TUM trajectory, camera to world; see `read_number_rows`.

    Trackers that are lost write NaN or a quaternion of zeros.
    """
    meaning = "time tx ty tz qx qy qz qw"
    return read_number_rows(path, 8, meaning, setting, few=few, least=least, quaternion=slice(4, 8))


def tum_poses(rows: NumberRows) -> NDArray[np.float64]:
    """Return T_camera_world (N, 4, 4) of a TUM trajectory's rows. Raises InputError as `poses_of_quaternions` does."""
    return inverse_poses(poses_of_quaternions(rows.values[:, 1:4], rows.values[:, 4:8], rows.where))


def poses_of_quaternions(
    translation: NDArray[np.float64], quaternion: NDArray[np.float64], where: Callable[[int], str]
) -> NDArray[np.float64]:
    """Convert translations and quaternions to poses (N, 4, 4).

    Args:
        translation: Translations (N, 3).
        quaternion: Quaternions (N, 4) as (x, y, z, w).
        where: Maps a row to file and line, for error messages.

    Raises:
        InputError: If a quaternion is not of unit length, or a position lies beyond `FARTHEST` or is NaN.
    """
    far = np.flatnonzero(~(np.abs(translation) <= FARTHEST).all(axis=1))
    if len(far):
        raise InputError(f"{where(int(far[0]))}: the position lies beyond {FARTHEST:g}; the file is damaged")
    with np.errstate(over="ignore"):  # an infinite length is rejected below
        length = np.linalg.norm(quaternion, axis=1)
    wrong = np.flatnonzero(~(np.abs(length - 1.0) <= MAX_LENGTH_ERROR))
    if len(wrong):
        raise InputError(
            f"{where(int(wrong[0]))}: the quaternion qx qy qz qw has length {length[wrong[0]]:.4g} instead of 1; "
            "check the order of the columns"
        )
    poses = np.tile(np.eye(4), (len(quaternion), 1, 1))
    poses[:, :3, :3] = matrices_from_unit_quaternions((quaternion / length[:, None])[:, [3, 0, 1, 2]])
    poses[:, :3, 3] = translation
    return poses


def checked_pose(matrix: NDArray[np.float64], what: str) -> NDArray[np.float64]:
    """Validate a pose (4, 4) and return the nearest rigid motion.

    The rotation is projected onto SO(3) by SVD; the translation is kept.

    Args:
        matrix: Pose (4, 4).
        what: Start of the error message, such as file and line.

    Raises:
        InputError: If the matrix contains NaN, Inf or values beyond `FARTHEST`, or is not a rigid motion.
    """
    rotation, translation = matrix[:3, :3], matrix[:3, 3]
    if not np.isfinite(matrix).all():
        raise InputError(f"{what}: the pose holds NaN or infinite numbers")
    if np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-6:
        raise InputError(f"{what}: the last row of the pose must be 0 0 0 1")
    if np.abs(matrix).max() > FARTHEST:
        raise InputError(f"{what}: the pose holds numbers beyond {FARTHEST:g}; the file is damaged")
    defect = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if defect > MAX_ROTATION_DEFECT:
        raise InputError(
            f"{what}: the pose is no rigid motion (R^T R differs from the identity by {defect:.2g}); "
            "give a rotation without scale or shear"
        )
    if np.linalg.det(rotation) < 0:
        raise InputError(f"{what}: the pose mirrors (determinant -1); its axes are not those of a camera")
    u, _, vt = np.linalg.svd(rotation)
    pose = np.eye(4)
    pose[:3, :3] = u @ vt
    pose[:3, 3] = translation
    return pose
