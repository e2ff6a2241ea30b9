"""Poses in files: lines in TUM format, quaternions and matrices."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_poses, matrices_from_unit_quaternions
from modp_ti.files.errors import InputError
from modp_ti.files.number_rows import NumberRows, read_number_rows

FARTHEST = 1e12
"""Largest valid coordinate [scene units]. Squared coordinates must fit the map's float32."""

MATRICES: dict[int, str] = dict.fromkeys((12, 16), "; a matrix in each line is tracker.kind: matrices")

# Largest deviation of a quaternion's length from 1. Rounding in text files stays below it.
MAX_LENGTH_ERROR = 1e-2
# Largest deviation of R^T R from the identity. Rounding in text files stays below it.
MAX_ROTATION_DEFECT = 1e-2


def read_tum_rows(path: Path, setting: str = "tracker.path", few: float = 0.0, least: int = 1) -> NumberRows:
    """Read the lines `time tx ty tz qx qy qz qw` of a TUM trajectory, camera to world; see `read_number_rows`.

    Trackers that are lost write NaN or a quaternion of zeros.
    """
    meaning = "time tx ty tz qx qy qz qw"
    return read_number_rows(path, 8, meaning, setting, few=few, least=least, lost=_is_lost, others=MATRICES)


def _is_lost(row: list[float]) -> bool:
    return not any(row[4:8])


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
