"""`PoseCorrection`: a tracker's revision of poses that it delivered earlier."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fields.frames.camera_revision import CameraRevision

__all__ = ["PoseCorrection"]


@dataclass(frozen=True)
class PoseCorrection:
    """Revised poses and points after a bundle adjustment or a loop closure, and the camera if it was estimated anew.

    Frames that are not listed follow the listed frames around them, or keep their poses with `others_stay`. A new
    camera is that of all frames, those after the correction included.

    Attributes:
        index: Indices (N,) int64 of the frames, increasing.
        T_camera_world: Revised tracked poses (N, 4, 4) float64.
        ids: Ids (M,) int64 of the tracked points that moved; may be empty.
        xyz: New positions (M, 3) float64 of these points in the world frame.
        camera: The new camera; None if it stays the same.
        others_stay: Whether frames that are not listed keep their poses.

    Raises:
        ValueError: If there is no pose, a value is not finite, the shapes disagree, or the indices are negative or not
            increasing.

    Example:
        mapper.correct(modp_ti.PoseCorrection(np.array([0, 1]), np.stack([np.eye(4), T_camera_world])))
    """

    index: NDArray[np.int64]
    T_camera_world: NDArray[np.float64]
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    xyz: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    camera: CameraRevision | None = None
    others_stay: bool = False

    def __post_init__(self) -> None:
        n, m = len(self.index), len(self.ids)
        if n == 0 or self.T_camera_world.shape != (n, 4, 4) or not np.isfinite(self.T_camera_world).all():
            raise ValueError(f"a correction needs finite poses ({n}, 4, 4), not {self.T_camera_world.shape}")
        if (np.diff(self.index) <= 0).any() or self.index[0] < 0:
            raise ValueError("frames of a correction must be named once each, in their order")
        if self.xyz.shape != (m, 3) or not np.isfinite(self.xyz).all():
            raise ValueError(f"a correction's points must be finite ({m}, 3), not {self.xyz.shape}")
