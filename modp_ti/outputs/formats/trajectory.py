"""Trajectories in TUM format: lines of `time tx ty tz qx qy qz qw`, camera to world, with `#` comments."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.atomic import replace_text
from modp_ti.files.trajectory import read_tum_rows, tum_poses


def write_trajectory(
    path: str | os.PathLike[str], timestamps: Iterable[float], poses: Iterable[NDArray[np.float64]]
) -> None:
    """Write one line per frame. The file appears whole or not at all.

    Numbers are written with enough digits to be read back exactly.

    Args:
        path: The file.
        timestamps: Time stamps [s].
        poses: T_camera_world (4, 4) of each frame.

    Raises:
        ValueError: If a pose contains NaN or Inf, or the numbers of time stamps and poses differ.
    """
    lines = ["# time tx ty tz qx qy qz qw   (seconds, camera to world)"]
    for time, T_camera_world in zip(timestamps, poses, strict=True):
        if not np.isfinite(T_camera_world).all():
            raise ValueError(f"the pose at {time} s is not finite")
        lines.append(tum_line(time, T_camera_world))
    replace_text(path, "\n".join(lines) + "\n")


def tum_line(time: float, T_camera_world: NDArray[np.float64]) -> str:
    """Return the line of a pose (4, 4), with enough digits to be read back exactly."""
    rotation = np.asarray(T_camera_world, dtype=np.float64)[:3, :3].T
    centre = -rotation @ T_camera_world[:3, 3]
    numbers = [float(time), *centre.tolist(), *_quaternion(rotation).tolist()]
    return " ".join(repr(number + 0.0) for number in numbers)  # + 0.0 turns -0.0 into 0.0


def read_trajectory(path: str | os.PathLike[str]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read a TUM trajectory.

    Args:
        path: The file.

    Returns:
        Time stamps (N,) [s] and T_camera_world (N, 4, 4), in the file's order.

    Raises:
        InputError: If the file is not a TUM trajectory. The message names the line.
    """
    rows = read_tum_rows(Path(path), "a trajectory in TUM's format", least=0)
    return rows.values[:, 0], tum_poses(rows)


def _quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (x, y, z, w) with w >= 0 as an eigenvector of Bar-Itzhack's matrix, which is stable for all rotations."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    K = np.array(
        [
            [xx - yy - zz, xy + yx, xz + zx, zy - yz],
            [xy + yx, yy - xx - zz, yz + zy, xz - zx],
            [xz + zx, yz + zy, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    q = np.linalg.eigh(K)[1][:, -1]
    return q if q[3] >= 0 else -q
