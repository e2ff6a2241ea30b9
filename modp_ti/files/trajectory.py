"""Poses in text files: lines in TUM format, and quaternions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_poses, matrices_from_unit_quaternions
from modp_ti.files.errors import InputError
from modp_ti.files.number_rows import NumberRows, read_number_rows

__all__ = ["FARTHEST", "poses_of_quaternions", "read_tum_rows", "tum_poses"]

FARTHEST = 1e12
"""Largest valid coordinate [scene units]. Squared coordinates must fit the map's float32."""

# Largest deviation of a quaternion's length from 1. Rounding in text files stays below it.
MAX_LENGTH_ERROR = 1e-2


def read_tum_rows(path: Path, setting: str = "tracker.path", few: float = 0.0, least: int = 1) -> NumberRows:
    """Read the lines `time tx ty tz qx qy qz qw` of a TUM trajectory, camera to world; see `read_number_rows`."""
    return read_number_rows(path, 8, "time tx ty tz qx qy qz qw", setting, few=few, least=least)


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
