"""Covisibility: the overlap of two views by their tracked points (Section 3.3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.keyframe import Keyframe


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
