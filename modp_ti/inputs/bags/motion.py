"""The motion of one frame in another, as poses at some times, and its interpolation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import poses_of_quaternions

# Between quaternions whose cosine is larger, rotations are interpolated linearly: the sine of the angle is too small.
ALMOST_EQUAL = 1.0 - 1e-9


@dataclass(frozen=True)
class Motion:
    """Poses T_parent_child over time.

    Attributes:
        times: Times (N,) [s], increasing; one time for a transform that always holds.
        T_parent_child: Poses (N, 4, 4).
        quaternions: Their rotations (N, 4) as (x, y, z, w).
        fixed: Whether the transform holds at all times.
    """

    times: NDArray[np.float64]
    T_parent_child: NDArray[np.float64]
    quaternions: NDArray[np.float64]
    fixed: bool = False

    @staticmethod
    def of_rows(rows: NDArray[np.float64], fixed: bool, where: str) -> Motion:
        """Return the motion of rows (N, 8) of time, position and quaternion (x, y, z, w), in any order.

        Rows of NaN or of a quaternion of zeros, which trackers write when they are lost, are left out. Of rows of the
        same time, and of fixed transforms, the last one holds.

        Raises:
            InputError: If there is no other row, or a quaternion is not of unit length.
        """
        rows = rows[np.isfinite(rows).all(axis=1) & rows[:, 4:].any(axis=1)]
        if len(rows) == 0:
            raise InputError(f"{where}: all poses are NaN, or have quaternions of zeros")
        if fixed:
            rows = rows[-1:]
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        rows = rows[np.append(np.diff(rows[:, 0]) > 0, True)]
        poses = poses_of_quaternions(rows[:, 1:4], rows[:, 4:], lambda n: f"{where} at {rows[n, 0]:.6f} s")
        return Motion(rows[:, 0], poses, rows[:, 4:] / np.linalg.norm(rows[:, 4:], axis=1)[:, None], fixed)

    def at(self, times: NDArray[np.float64], max_gap: float) -> NDArray[np.float64]:
        """Return T_parent_child (M, 4, 4) at times (M,) [s].

        Positions are interpolated linearly and rotations along the shortest arc. A time of one of the poses has that
        pose. Poses are NaN before the first and after the last one, and between two that lie more than `max_gap` [s]
        apart.
        """
        if self.fixed:
            return np.repeat(self.T_parent_child, len(times), axis=0)
        last = len(self.times) - 1
        a = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, last)
        b = np.minimum(a + 1, last)
        span = self.times[b] - self.times[a]
        t = np.divide(times - self.times[a], span, out=np.zeros(len(times)), where=span > 0).clip(0.0, 1.0)
        result = np.tile(np.eye(4), (len(times), 1, 1))
        result[:, :3, 3] = _mixed(self.T_parent_child[a, :3, 3], self.T_parent_child[b, :3, 3], 1.0 - t, t)
        quaternions = self._turned(a, b, t)
        result[:, :3, :3] = poses_of_quaternions(np.zeros((len(times), 3)), quaternions, str)[:, :3, :3]
        exact = times == self.times[a]
        result[exact] = self.T_parent_child[a[exact]]
        outside = (times < self.times[0]) | (times > self.times[last])
        result[~exact & (outside | (span > max_gap))] = np.nan
        return result

    def _turned(self, a: NDArray[np.int64], b: NDArray[np.int64], t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Interpolate between the quaternions of the rows `a` and `b`."""
        q_a, q_b = self.quaternions[a], self.quaternions[b]
        cosine = (q_a * q_b).sum(axis=1)
        q_b = np.where(cosine[:, None] < 0, -q_b, q_b)
        cosine = np.abs(cosine)
        angle = np.arccos(np.minimum(cosine, ALMOST_EQUAL))
        q = _mixed(q_a, q_b, np.sin((1.0 - t) * angle), np.sin(t * angle))
        return q / np.linalg.norm(q, axis=1)[:, None]


def _mixed(
    a: NDArray[np.float64], b: NDArray[np.float64], of_a: NDArray[np.float64], of_b: NDArray[np.float64]
) -> NDArray[np.float64]:
    return of_a[:, None] * a + of_b[:, None] * b
