"""Keyframe selection by the overlap of tracked points (Section 3.3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
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

    Attributes:
        previous: Index of the previous frame; None before the first one.
    """

    def __init__(self, settings: KeyframeSettings, trajectory: Trajectory) -> None:
        self.settings = settings
        self.trajectory = trajectory
        self.previous: int | None = None

    def is_keyframe(self, frame: TrackedFrame, last: Keyframe | None) -> bool:
        """Whether a frame becomes a keyframe after the last one of its view. Call it once per frame, in order."""
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


@dataclass(frozen=True)
class SeenPoints:
    """The part of a view that covisibility depends on.

    Attributes:
        camera: Camera of the view.
        T_camera_world: Pose (4, 4).
        xyz: Tracked points (N, 3) in the world frame.
    """

    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]
    xyz: NDArray[np.float64]

    @classmethod
    def of(cls, view: TrackedFrame | Keyframe) -> SeenPoints:
        """Take the camera, pose and points of a frame or keyframe."""
        return cls(view.camera, view.T_camera_world, view.points.xyz)

    @property
    def farthest(self) -> float:
        """Depth of the farthest tracked point [scene units]."""
        return float((self.xyz @ self.T_camera_world[2, :3]).max() + self.T_camera_world[2, 3])

    def count(self, xyz: NDArray[np.float64]) -> int:
        """Count the world points (N, 3) that lie in the image and no deeper than `farthest`."""
        p = xyz @ self.T_camera_world[:3, :3].T + self.T_camera_world[:3, 3]
        p = p[(p[:, 2] > 0) & (p[:, 2] <= self.farthest)]
        return int(np.count_nonzero(self.camera.contains(self.camera.project(p))))


def covisibility(a: SeenPoints, b: SeenPoints) -> float:
    """Overlap of two views in [0, 1] (Section 3.3.1).

    The overlap is m / (m + only_a + only_b). m is the mean of the number of a's points that b sees and the number of
    b's points that a sees; only_a and only_b count the points that the other view does not see.

    Returns:
        The overlap; 0.1 if either view has no points.
    """
    if len(a.xyz) == 0 or len(b.xyz) == 0:
        return 0.1
    a_in_b, b_in_a = b.count(a.xyz), a.count(b.xyz)
    shared = 0.5 * (a_in_b + b_in_a)
    only = (len(a.xyz) - a_in_b) + (len(b.xyz) - b_in_a)
    return shared / max(shared + only, 1e-9)
