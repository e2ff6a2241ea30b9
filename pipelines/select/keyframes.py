"""Keyframe selection by the overlap of tracked points (Section 3.3.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.se3 import inverse_se3
from fields.map.covisibility import SeenPoints, covisibility
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from fields.map.trajectory import Trajectory
from pipelines.select.gate import sharpness
from pipelines.settings import KeyframeSettings


class KeyframeSelector:
    """Decides for each frame whether it becomes a keyframe.

    The paper rejects every frame that turned by more than 10 degrees since the previous one, as blurred. Here such a
    frame is rejected only if its image is blurred as well. In a collection of photographs, large rotations between
    sharp images are common, and rejecting them would leave parts of the scene unmapped.

    Args:
        settings: Settings of the selection.
        trajectory: Tracked poses of the frames so far.

    Attributes:
        previous: Index of the previous frame; None before the first one.
    """

    def __init__(self, settings: KeyframeSettings, trajectory: Trajectory) -> None:
        self.settings = settings
        self.trajectory = trajectory
        self.previous: int | None = None

    def is_keyframe(self, frame: TrackedFrame, last: Keyframe | None) -> bool:
        """Whether `frame` becomes a keyframe. Call it once per frame, in order.

        Args:
            frame: The frame.
            last: The latest keyframe of the same view; None if there is none.
        """
        previous, self.previous = self.previous, frame.index
        if len(frame.points) < self.settings.min_points:
            return False
        if last is None or previous is None:
            return True
        if frame.index - last.index > self.settings.max_gap * frame.views:
            return True
        if rotation_per_frame(
            previous, self.trajectory[previous], frame
        ) > self.settings.max_rotation and self._is_blurred(frame, last):
            return False
        centre, before = (inverse_se3(view.T_camera_world)[:3, 3] for view in (frame, last))
        moved = np.linalg.norm(centre - before)
        if moved > self.settings.baseline * last.median_depth:
            return True
        return covisibility(SeenPoints.of(frame), SeenPoints.of(last)) < self.settings.covisibility

    def is_between(self, frame: TrackedFrame, store: KeyframeStore) -> bool:
        """Whether a frame that does not become a keyframe becomes a view between two of them.

        Each keyframe is followed by one at most, so that the views take twice the keyframes' memory at most.
        """
        wanted, last = self.settings.between, store[-1]
        if not wanted or last.is_between or frame.index - last.index < wanted:
            return False
        return not self._is_blurred(frame, last)

    def _is_blurred(self, frame: TrackedFrame, last: Keyframe) -> bool:
        return sharpness(frame.rgba) < self.settings.min_sharpness * sharpness(last.rgba)


def rotation_per_frame(index: int, T_camera_world: NDArray[np.float64], frame: TrackedFrame) -> float:
    """Rotation [degrees per frame] from frame `index` at `T_camera_world` (4, 4) to a later `frame`."""
    R = frame.T_camera_world[:3, :3] @ T_camera_world[:3, :3].T
    angle = np.degrees(np.arccos(np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0)))
    return float(angle) / max(frame.index - index, 1)
