"""Poses with times, as trackers write them, and which image each of them belongs to."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.config.tracker_settings import TimedPosesSettings
from modp_ti.files.errors import FEW, InputError
from modp_ti.files.number_rows import read_number_rows
from modp_ti.inputs.replay import FARTHEST
from modp_ti.inputs.sources import ImageSource
from modp_ti.inputs.sources.association import associate

__all__ = [
    "Trajectory",
    "inverse_poses",
    "poses_of_quaternions",
    "read_trajectory_file",
    "require_rising",
    "rows_at_frames",
]

TUM_COLUMNS = "time tx ty tz qx qy qz qw"
# A quaternion further from unit length than this was not meant as a rotation; below it lies the rounding of text files.
MAX_LENGTH_ERROR = 1e-2
# A time beyond this is no number of seconds (3 million years), but of nanoseconds.
NANOSECONDS_FROM = 1e14


@dataclass(frozen=True)
class Trajectory:
    """times: (N,) seconds, rising. T_camera_world: (N, 4, 4). path: where they come from, for messages.

    left_out: lines of the file that are no pose.
    """

    path: Path
    times: NDArray[np.float64]
    T_camera_world: NDArray[np.float64]
    left_out: int = 0

    def __len__(self) -> int:
        return len(self.times)


def read_trajectory_file(path: Path) -> Trajectory:
    """A trajectory in TUM's format: `time tx ty tz qx qy qz qw` a line, camera to world, in the order of time.

    Times are seconds, or, in ORB-SLAM3's EuRoC flavour, nanoseconds: their size tells. A few lines may hold NaN, as
    trackers write it where they are lost, or a time out of order: they are left out. Raises InputError with file and
    line for a wrong number of columns, a quaternion that is not of unit length, and where more lines are like that.
    """
    rows = read_number_rows(path, 8, TUM_COLUMNS, few=FEW)
    rising, left_out = _rising(rows.values[:, 0]), rows.left_out
    if len(rows) - len(rising) <= FEW * len(rows):
        left_out += len(rows) - len(rising)
        rows = replace(rows, values=rows.values[rising], lines=rows.lines[rising])
    T_world_camera = poses_of_quaternions(rows.values[:, 1:4], rows.values[:, 4:8], rows.where)
    require_rising(rows.values[:, 0], rows.where)
    times = rows.values[:, 0] * (1e-9 if rows.values[-1, 0] >= NANOSECONDS_FROM else 1.0)
    return Trajectory(path, times, inverse_poses(T_world_camera), left_out)


def _rising(times: NDArray[np.float64]) -> NDArray[np.int64]:
    """Places of the most times that rise from one to the next: those before and behind a leap of the clock."""
    ends: list[float] = []  # the least end of a rising sequence of each length, and where it is
    places: list[int] = []
    before = np.full(len(times), -1)
    for i, time in enumerate(times.tolist()):
        length = bisect_left(ends, time)
        before[i] = places[length - 1] if length else -1
        ends[length : length + 1] = [time]
        places[length : length + 1] = [i]
    chain, i = [], places[-1]
    while i >= 0:
        chain.append(i)
        i = int(before[i])
    return np.array(chain[::-1], dtype=np.int64)


def poses_of_quaternions(
    translation: NDArray[np.float64], quaternion: NDArray[np.float64], where: Callable[[int], str]
) -> NDArray[np.float64]:
    """Poses (N, 4, 4) of translations (N, 3) and quaternions (N, 4) as (x, y, z, w).

    where(row): file and line, for the InputError about a quaternion that is not of unit length.
    """
    far = np.flatnonzero(~(np.abs(translation) <= FARTHEST).all(axis=1))
    if len(far):
        raise InputError(f"{where(int(far[0]))}: the position lies beyond {FARTHEST:g}; the file is damaged")
    with np.errstate(over="ignore"):  # an infinite length is no unit length either
        length = np.linalg.norm(quaternion, axis=1)
    wrong = np.flatnonzero(~(np.abs(length - 1.0) <= MAX_LENGTH_ERROR))
    if len(wrong):
        raise InputError(
            f"{where(int(wrong[0]))}: the quaternion qx qy qz qw has length {length[wrong[0]]:.4g} instead of 1; "
            "check the order of the columns"
        )
    x, y, z, w = (quaternion / length[:, None]).T
    poses = np.tile(np.eye(4), (len(quaternion), 1, 1))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    poses[:, :3, :3] = np.array(rows).transpose(2, 0, 1)
    poses[:, :3, 3] = translation
    return poses


def inverse_poses(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverses (N, 4, 4) of rigid motions (N, 4, 4)."""
    inverse = np.tile(np.eye(4), (len(poses), 1, 1))
    inverse[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    inverse[:, :3, 3] = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    return inverse


def require_rising(times: NDArray[np.float64], where: Callable[[int], str]) -> None:
    """Raises InputError for the first time that does not lie after the one before it."""
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        row = int(back[0]) + 1
        raise InputError(
            f"{where(row)}: time {times[row]:.6f} does not lie after {times[row - 1]:.6f} of the line before: "
            "sort the file by time and take doubles out"
        )


def rows_at_frames(
    images: ImageSource, names: Sequence[str], path: Path, times: NDArray[np.float64], tracker: TimedPosesSettings
) -> dict[str, int]:
    """The pose of each image that has one within `tracker.max_difference` of its time, as its row.

    times: (N,) [seconds] of the poses, before `tracker.time_offset`; path: where they come from, for messages.
    An image and a pose are used once, the nearest pairs first. Raises InputError where no image has one.
    """
    of_frames = np.array([images.timestamp(name) for name in names])
    shifted = times + tracker.time_offset
    pairs = associate(of_frames, shifted, tracker.max_difference)
    if len(pairs) == 0:
        raise InputError(
            f"{path}: no pose lies within {tracker.max_difference:g} s of a frame: its times run from "
            f"{shifted[0]:.6f} to {shifted[-1]:.6f} s, those of the frames from {of_frames.min():.6f} to "
            f"{of_frames.max():.6f} s; check source.fps, tracker.time_offset and tracker.max_difference"
        )
    return {names[frame]: pose for frame, pose in pairs.tolist()}
