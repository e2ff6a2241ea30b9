"""The named frames of a bag, and the transforms between them."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_poses
from modp_ti.files.errors import InputError
from modp_ti.inputs.bags.bag import STATIC, TREES, Bag
from modp_ti.inputs.bags.motion import Motion


def clean(frame: str) -> str:
    """Return the name of a frame without the slash that ROS 1 may begin it with."""
    return frame.lstrip("/")


def seconds(stamp: Any) -> float:
    """Return the time of a stamp [s]."""
    return float(stamp.sec + stamp.nanosec * 1e-9)


def pose_row(time: float, position: Any, orientation: Any) -> list[float]:
    """Return time, position and quaternion (x, y, z, w) of a message as numbers."""
    return [
        *(time, position.x, position.y, position.z),
        *(orientation.x, orientation.y, orientation.z, orientation.w),
    ]


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
                row = pose_row(seconds(each.header.stamp), transform.translation, transform.rotation)
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
