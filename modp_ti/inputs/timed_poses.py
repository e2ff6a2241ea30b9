"""Trajectories of timed poses, and the frames that they belong to by time. Ground truth is one of them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modp_ti.files.errors import FEW, InputError
from modp_ti.files.trajectory import read_tum_rows, tum_poses
from modp_ti.inputs.protocol import Before

# Units of times that are not seconds. Nanoseconds may have been taken for such from NANOSECONDS_FROM on.
UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9, "microseconds since 1970": 1e3}

# Times from here on are nanoseconds: in seconds they would be 3 million years.
NANOSECONDS_FROM = 1e14

MAX_DIFFERENCE = 0.02
"""Largest time difference of a pair [s], as in the TUM benchmark."""

# Above MANY_PAIRS candidate pairs, only the NEAREST candidates on each side of a time are compared, to bound memory.
MANY_PAIRS = 4_000_000
NEAREST = 64

# A similarity has 7 parameters. Three camera centres that are not on a line determine it.
LEAST_FRAMES = 3


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


def on_the_clock_of(
    of_frames: NDArray[np.float64],
    every: NDArray[np.float64],
    times: NDArray[np.float64],
    offset: float,
    limit: float,
    path: str,
) -> tuple[NDArray[np.float64], NDArray[np.int64], str]:
    """Bring the times of poses to the clock of images, and associate both.

    Numbers of images and other units than seconds are recognised where far more images have a pose then.

    Args:
        of_frames: Times (F,) of the images [s].
        every: Times of all images of the recording [s], which numbers of images refer to.
        times: Times (N,) of the poses.
        offset: Added to the times of the poses [s].
        limit: Largest difference of a pair [s].
        path: Origin of the poses, for messages.

    Returns:
        Times (N,) of the poses [s], pairs (M, 2) of an image and a pose as of `associate`, and a remark if the times
        are not in seconds.

    Raises:
        InputError: If two units fit equally well.
    """
    readings = {"": times + offset}
    pairs = {"": associate(of_frames, readings[""], limit)}
    least = 0.5 * min(len(of_frames), len(times))
    if len(pairs[""]) >= least:
        return readings[""], pairs[""], ""
    readings |= {f"are {unit}": times * factor + offset for unit, factor in UNITS.items()}
    first = int(times[-1] == len(every) and times[0] > 0)
    if times[0] >= 0 and times[-1] - first < len(every) and not (times % 1).any():
        readings[f"count frames from {first}"] = every[times.astype(np.int64) - first] + offset
    pairs = {remark: associate(of_frames, seconds, limit) for remark, seconds in readings.items()}
    second, best = sorted(pairs, key=lambda remark: len(pairs[remark]))[-2:]
    if len(pairs[best]) <= max(2 * len(pairs[""]), least):
        best = ""
    elif 2 * len(pairs[second]) > len(pairs[best]):
        raise InputError(f"{path}: its times either {best} or {second}: write them in seconds")
    return readings[best], pairs[best], best


def associate(times_a: ArrayLike, times_b: ArrayLike, max_difference: float = MAX_DIFFERENCE) -> NDArray[np.int64]:
    """Associate two lists of times greedily: the pair with the smallest difference is taken first.

    Each time is in at most one pair. If two differences are equal, the pair with the lower indices is taken first.

    Args:
        times_a: Times (N,) [s], in any order.
        times_b: Times (K,) [s], in any order.
        max_difference: Largest difference of a pair [s].

    Returns:
        Pairs (M, 2) of indices into `times_a` and `times_b`, sorted by the first.

    Raises:
        ValueError: If a time is not finite.
    """
    a, b = np.asarray(times_a, dtype=np.float64).ravel(), np.asarray(times_b, dtype=np.float64).ravel()
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("time stamps must be finite numbers")
    order = np.argsort(b, kind="stable")
    first = np.searchsorted(b[order], a - max_difference, side="left")
    behind = np.searchsorted(b[order], a + max_difference, side="right")
    if (behind - first).sum() > MANY_PAIRS:
        at = np.searchsorted(b[order], a)
        first, behind = np.maximum(first, at - NEAREST), np.minimum(behind, at + NEAREST)
    count = np.maximum(behind - first, 0)
    # All candidate pairs: entry i of a with order[first[i]], order[first[i] + 1], ...
    of_a = np.repeat(np.arange(len(a)), count)
    step = np.arange(len(of_a)) - np.repeat(np.cumsum(count) - count, count)
    of_b = order[np.repeat(first, count) + step]

    free_a, free_b = np.ones(len(a), dtype=bool), np.ones(len(b), dtype=bool)
    pairs = []
    for k in np.lexsort((of_b, of_a, np.abs(a[of_a] - b[of_b]))):
        i, j = of_a[k], of_b[k]
        if free_a[i] and free_b[j]:
            free_a[i] = free_b[j] = False
            pairs.append((i, j))
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def open_ground_truth(path: Path | None) -> TimedPoses | None:
    """Read `source.ground_truth`, a trajectory in TUM format. None if the scene has none.

    Raises:
        InputError: If the file is missing or malformed.
    """
    if path is None:
        return None
    if not path.is_file():
        raise InputError(f"{path}: no such file (source.ground_truth); it should be a trajectory in TUM's format")
    return read_trajectory_file(path)


def true_poses(
    truth: TimedPoses, timestamps: Sequence[float], before: Before | None = None
) -> tuple[list[NDArray[np.float64]], str | None]:
    """Associate a trajectory with frames by time, within `MAX_DIFFERENCE`.

    Args:
        truth: The true trajectory.
        timestamps: Times (N,) of the frames [s].
        before: Frames of an earlier map that come first, which have no true poses; None for none.

    Returns:
        The true T_camera_world (4, 4) of every frame, NaN where the trajectory has none; empty if fewer than three
        frames have one. And a note for the user if frames have none.
    """
    before = before or Before()
    own = [time - before.shift for time in timestamps[before.frames :]]
    pairs = associate(own, truth.times, MAX_DIFFERENCE)
    note = None
    if len(pairs) < len(own):
        note = (
            f"{len(own) - len(pairs)} of {len(own)} frames have no pose in {truth.path} within "
            f"{MAX_DIFFERENCE:g} s: not in the trajectory errors"
        )
    if len(pairs) < LEAST_FRAMES:
        return [], note
    poses = np.full((len(timestamps), 4, 4), np.nan)
    poses[before.frames + pairs[:, 0]] = truth.T_camera_world[pairs[:, 1]]
    return list(poses), note
