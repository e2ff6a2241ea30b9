"""What a run keeps of every frame that its tracker delivered."""

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
    """Name, time, camera and tracked pose of every frame in their order, and the points that it saw.

    held_out: whether a frame was only for evaluation. corrections: how many came, and how many of them moved the map.
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
        """Keep the next frame, but for its image. with_points: whether also which points it saw where."""
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
        """Take over the poses and points that the tracker names; the others go with the world around them.

        moved: whether the map did.
        """
        named = {int(i): T for i, T in zip(correction.index, correction.T_camera_world, strict=True)}
        around = [motion.of(index, T) for index, T in zip(self.index, self.T_tracked, strict=True)]
        self.T_tracked = [named.get(index, T) for index, (T, _) in zip(self.index, around, strict=True)]
        self.points.correct(correction.ids, correction.xyz, [S for _, S in around])
        self.corrections["received"] += 1
        self.corrections["moved"] += moved
