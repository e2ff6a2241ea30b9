"""The named frames of a bag: their motions, the tree of transforms, and topics of poses."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import interpolate_se3, inverse_poses
from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import poses_of_quaternions
from modp_ti.inputs.bags.bag import STATIC, TREES, Bag


@dataclass(frozen=True)
class Motion:
    """Poses T_parent_child over time.

    Attributes:
        times: Times (N,) [s], increasing; one time for a transform that always holds.
        T_parent_child: Poses (N, 4, 4).
        fixed: Whether the transform holds at all times.
    """

    times: NDArray[np.float64]
    T_parent_child: NDArray[np.float64]
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
        return Motion(rows[:, 0], poses, fixed)

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
        result, T_b = self.T_parent_child[a], self.T_parent_child[b]
        places = (1.0 - t)[:, None] * result[:, :3, 3] + t[:, None] * T_b[:, :3, 3]
        for n in np.flatnonzero(t).tolist():
            result[n] = interpolate_se3(result[n], T_b[n], float(t[n]))
            result[n, :3, 3] = places[n]
        exact = times == self.times[a]
        outside = (times < self.times[0]) | (times > self.times[last])
        result[~exact & (outside | (span > max_gap))] = np.nan
        return result


class FrameTree:
    """Motions between named frames.

    Args:
        motions: The motion of a frame in another, by the names (parent, child).
    """

    def __init__(self, motions: Mapping[tuple[str, str], Motion]) -> None:
        self._motions = dict(motions)

    def add(self, parent: str, child: str, motion: Motion) -> None:
        """Add a motion, in place of the one between these frames if there is one."""
        self._motions.pop((child, parent), None)
        self._motions[parent, child] = motion

    @property
    def frames(self) -> list[str]:
        """The names of all frames."""
        return sorted({frame for pair in self._motions for frame in pair})

    @property
    def moves(self) -> bool:
        """Whether any transform changes."""
        return not all(motion.fixed for motion in self._motions.values())

    def root(self, frame: str) -> str:
        """Return the frame that has no parent, of those above a frame."""
        parent_of = {child: parent for parent, child in self._motions}
        seen = {frame}
        while frame in parent_of and parent_of[frame] not in seen:
            frame = parent_of[frame]
            seen.add(frame)
        return frame

    def at(self, parent: str, child: str, times: NDArray[np.float64], max_gap: float) -> NDArray[np.float64] | None:
        """Return T_parent_child (M, 4, 4) at times (M,) [s], NaN where a motion is not known; see `Motion.at`.

        Returns:
            The poses, or None if the frames are not connected.
        """
        steps = self._steps(parent, child)
        if steps is None:
            return None
        result = np.tile(np.eye(4), (len(times), 1, 1))
        for motion, inverted in steps:
            T = motion.at(times, max_gap)
            result = result @ (inverse_poses(T) if inverted else T)
        return result

    def _steps(self, parent: str, child: str) -> list[tuple[Motion, bool]] | None:
        """Return the shortest way from one frame to another, as motions and whether they are inverted."""
        ways: dict[str, list[tuple[Motion, bool]]] = {parent: []}
        waiting = deque([parent])
        while waiting and child not in ways:
            here = waiting.popleft()
            for (above, below), motion in self._motions.items():
                for start, end, inverted in ((above, below, False), (below, above, True)):
                    if start == here and end not in ways:
                        ways[end] = [*ways[here], (motion, inverted)]
                        waiting.append(end)
        return ways.get(child)


@dataclass(frozen=True)
class PoseTopic:
    """The poses of a topic.

    Attributes:
        world: Name of the frame that the poses are in.
        body: Name of the frame that they are of; empty if the messages do not tell.
        motion: The poses T_world_body.
    """

    world: str
    body: str
    motion: Motion


# ---- messages ----------------------------------------------------------------------------------------------------


def clean(frame: str) -> str:
    """Return the name of a frame without the slash that ROS 1 may begin it with."""
    return frame.lstrip("/")


def seconds(stamp: Any) -> float:
    """Return the time of a stamp [s]."""
    return float(stamp.sec + stamp.nanosec * 1e-9)


def _row(time: float, position: Any, orientation: Any) -> list[float]:
    """Return time, position and quaternion (x, y, z, w) of a message as numbers."""
    return [
        *(time, position.x, position.y, position.z),
        *(orientation.x, orientation.y, orientation.z, orientation.w),
    ]


def read_frame_tree(bag: Bag) -> FrameTree:
    """Read the transforms of a bag, which may have none.

    Raises:
        InputError: If the bag is damaged.
    """
    rows: dict[tuple[str, str], list[list[float]]] = {}
    fixed: set[tuple[str, str]] = set()
    for topic in bag.of_types(*TREES):
        for _, message in bag.messages(topic):
            for each in message.transforms:
                pair = clean(each.header.frame_id), clean(each.child_frame_id)
                transform = each.transform
                row = _row(seconds(each.header.stamp), transform.translation, transform.rotation)
                rows.setdefault(pair, []).append(row)
                if topic.rpartition("/")[2] == STATIC:
                    fixed.add(pair)
    motions = {}
    for pair, its in rows.items():
        where = f"{bag.path}: transform from {pair[1]!r} to {pair[0]!r}"
        try:
            motions[pair] = Motion.of_rows(np.array(its), pair in fixed, where)
        except InputError:
            continue
    return FrameTree(motions)


def read_pose_topic(bag: Bag, topic: str) -> PoseTopic:
    """Read the poses of a topic.

    Raises:
        InputError: If the bag is damaged, or the poses are none.
    """
    rows, world, body = [], "", ""
    for _, message in bag.messages(topic):
        world, body = clean(message.header.frame_id), clean(getattr(message, "child_frame_id", ""))
        time = seconds(message.header.stamp)
        if message.__msgtype__ == "geometry_msgs/msg/TransformStamped":
            rows.append(_row(time, message.transform.translation, message.transform.rotation))
            continue
        # Odometry and PoseWithCovarianceStamped state how certain the pose is.
        pose = message.pose if message.__msgtype__ == "geometry_msgs/msg/PoseStamped" else message.pose.pose
        rows.append(_row(time, pose.position, pose.orientation))
    return PoseTopic(world, body, Motion.of_rows(np.array(rows).reshape(-1, 8), False, f"{bag.path}: {topic}"))
