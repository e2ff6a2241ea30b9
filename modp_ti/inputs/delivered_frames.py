"""The record that a run keeps of every frame delivered by its tracker."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.tracked_points import TrackedPoints
from pipelines.corrections import WorldMotion

__all__ = ["DeliveredFrames"]


@dataclass
class DeliveredFrames:
    """Metadata, tracked poses and observed points of all delivered frames, in order. Images are not kept.

    Attributes:
        index: Index of each frame, as in `TrackedFrame.index`.
        name: Image name of each frame.
        timestamp: Time of each frame [s].
        camera: Camera of each frame.
        held_out: Whether each frame is only for evaluation.
        T_tracked: Tracked pose T_camera_world (4, 4) of each frame, including all corrections so far.
        points: Points and the frames that observed them.
        corrections: Number of pose corrections received, and of those that moved the map.
    """

    index: list[int] = field(default_factory=list)
    name: list[str] = field(default_factory=list)
    timestamp: list[float] = field(default_factory=list)
    camera: list[PinholeCamera] = field(default_factory=list)
    held_out: list[bool] = field(default_factory=list)
    T_tracked: list[NDArray[np.float64]] = field(default_factory=list)
    points: TrackedPoints = field(default_factory=TrackedPoints)
    corrections: dict[str, int] = field(default_factory=lambda: {"received": 0, "moved": 0})

    def __len__(self) -> int:
        return len(self.index)

    def add(self, frame: TrackedFrame, with_points: bool = True) -> None:
        """Record the next frame without its image.

        Args:
            frame: The next frame.
            with_points: Whether to record its point observations too.
        """
        self.index.append(frame.index)
        self.name.append(frame.name)
        self.timestamp.append(frame.timestamp)
        self.camera.append(frame.camera)
        self.held_out.append(frame.held_out)
        self.T_tracked.append(frame.T_camera_world)
        if with_points:
            self.points.add(frame)
        else:
            self.points.leave_out(frame)

    def correct(self, correction: PoseCorrection, motion: WorldMotion, moved: bool) -> None:
        """Apply a pose correction.

        Frames and points named in the correction take the corrected values. All others move with the world around
        them.

        Args:
            correction: The correction from the tracker.
            motion: Motion of frames and world that the correction implies.
            moved: Whether the correction moved the map.
        """
        named = {int(i): T for i, T in zip(correction.index, correction.T_camera_world, strict=True)}
        around = [motion.of(index, T) for index, T in zip(self.index, self.T_tracked, strict=True)]
        self.T_tracked = [named.get(index, T) for index, (T, _) in zip(self.index, around, strict=True)]
        self.points.correct(correction.ids, correction.xyz, [S for _, S in around])
        self.corrections["received"] += 1
        self.corrections["moved"] += moved
