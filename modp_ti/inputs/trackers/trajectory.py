"""Trajectories of timed poses, and the images that they belong to."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_base_settings import TimedPosesSettings
from modp_ti.files.errors import FEW, InputError
from modp_ti.files.trajectory import read_tum_rows, tum_poses
from modp_ti.inputs.association import associate
from modp_ti.inputs.sources import ImageSource
from modp_ti.inputs.trackers.given_poses import missing_frames_note, selected_frames

__all__ = ["TimedPoses", "read_trajectory_file", "require_rising", "rows_at_frames"]

# Units of times that are not seconds. Nanoseconds may have been taken for such from NANOSECONDS_FROM on.
UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9, "microseconds since 1970": 1e3}

# Times from here on are nanoseconds: in seconds they would be 3 million years.
NANOSECONDS_FROM = 1e14


@dataclass(frozen=True)
class TimedPoses:
    """Poses over time.

    Attributes:
        path: The file, for error messages.
        times: Times (N,) [s], strictly increasing.
        T_camera_world: Poses (N, 4, 4), world to camera.
        left_out: Number of skipped lines.
    """

    path: Path
    times: NDArray[np.float64]
    T_camera_world: NDArray[np.float64]
    left_out: int = 0


def read_trajectory_file(path: Path) -> TimedPoses:
    """Read a trajectory in TUM format: `time tx ty tz qx qy qz qw` per line, camera to world, ordered by time.

    Times are in seconds, or in nanoseconds in ORB-SLAM3's EuRoC variant; the magnitude decides. Lines with NaN, which
    trackers write when they are lost, and lines with times out of order are skipped, up to a share `FEW` each.

    Raises:
        InputError: If a line has the wrong number of columns or a quaternion that is not of unit length, or if too many
            lines are faulty. The message names file and line.
    """
    rows = read_tum_rows(path, few=FEW)
    rising, left_out = _rising(rows.values[:, 0]), rows.left_out
    if len(rows) - len(rising) <= FEW * len(rows):
        left_out += len(rows) - len(rising)
        rows = replace(rows, values=rows.values[rising], lines=rows.lines[rising])
    T_camera_world = tum_poses(rows)
    require_rising(rows.values[:, 0], rows.where)
    times = rows.values[:, 0] * (1e-9 if rows.values[-1, 0] >= NANOSECONDS_FROM else 1.0)
    return TimedPoses(path, times, T_camera_world, left_out)


def _rising(times: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the indices of the longest strictly increasing subsequence of the times."""
    ends: list[float] = []  # smallest last value of an increasing subsequence of each length; `places` is its index
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


def require_rising(times: NDArray[np.float64], where: Callable[[int], str]) -> None:
    """Raise InputError if the times are not strictly increasing. The message names the first offending row."""
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        row = int(back[0]) + 1
        raise InputError(
            f"{where(row)}: time {times[row]:.6f} does not lie after {times[row - 1]:.6f} of the line before: "
            "sort the file by time and take doubles out"
        )


def rows_at_frames(
    images: ImageSource, source: SourceSettings, path: Path, times: NDArray[np.float64], tracker: TimedPosesSettings
) -> tuple[dict[str, int], list[str]]:
    """Associate the selected images with poses by time.

    An image and a pose may differ by at most `tracker.max_difference`. Each is used once; the pairs nearest in time are
    matched first.

    Args:
        images: The image source.
        source: Settings of the images.
        path: Origin of the poses, for messages.
        times: Times (N,) of the poses [s], before `tracker.time_offset` is added.
        tracker: Settings of the tracker.

    Returns:
        The row of the pose of each matched image, by name in the source's order, and remarks for the user.

    Raises:
        InputError: If no image has a pose.
    """
    names = selected_frames(images, source)
    of_frames = np.array([images.whole.timestamp(name) for name in names])
    shifted, remark = _seconds(images, of_frames, path, times, tracker)
    pairs = associate(of_frames, shifted, tracker.max_difference)
    if len(pairs) == 0:
        raise InputError(
            f"{path}: no pose lies within {tracker.max_difference:g} s of a frame: its times run from "
            f"{shifted[0]:.6f} to {shifted[-1]:.6f} s, those of the frames from {of_frames.min():.6f} to "
            f"{of_frames.max():.6f} s; check source.fps, tracker.time_offset and tracker.max_difference"
        )
    rows = {names[int(frame)]: int(pose) for frame, pose in pairs}
    notes = [f"the times of {path.name} {remark}"] if remark else []
    return rows, [*notes, *missing_frames_note(names, rows, path.name)]


def _seconds(
    images: ImageSource,
    of_frames: NDArray[np.float64],
    path: Path,
    times: NDArray[np.float64],
    tracker: TimedPosesSettings,
) -> tuple[NDArray[np.float64], str]:
    """Return the times of the poses on the images' clock [s], and a remark if the file does not state seconds.

    Numbers of frames and other units are recognised where far more images have a pose then.
    """

    def count(seconds: NDArray[np.float64]) -> int:
        return len(associate(of_frames, seconds + tracker.time_offset, tracker.max_difference))

    least = 0.5 * min(len(of_frames), len(times))
    readings = {"": times}
    if count(times) < least:
        readings |= {f"are {unit}": times * factor for unit, factor in UNITS.items()}
        own = np.array([images.whole.timestamp(name) for name in images.whole.names])
        first = int(times[-1] == len(own) and times[0] > 0)
        if times[0] >= 0 and times[-1] - first < len(own) and not (times % 1).any():
            readings[f"count frames from {first}"] = own[times.astype(np.int64) - first]
    counts = {remark: count(seconds) for remark, seconds in readings.items()}
    second, best = sorted(counts, key=lambda remark: counts[remark])[-2:] if len(counts) > 1 else ("", "")
    if counts[best] <= max(2 * counts[""], least):
        best = ""
    elif 2 * counts[second] > counts[best]:
        raise InputError(f"{path}: its times either {best} or {second}: write them in seconds")
    return readings[best] + tracker.time_offset, best
