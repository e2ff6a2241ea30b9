"""`PoseCorrection`: what a tracker hands to the mapper when it revises poses that it has delivered before."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

__all__ = ["PoseCorrection"]


@dataclass(frozen=True)
class PoseCorrection:
    """Revised poses and points, after a bundle adjustment or a closed loop.

    index: (N,) int64, of the frames, increasing. T_camera_world: (N, 4, 4) float64, their tracked poses from now on; a
    frame that is not named follows those around it. ids (M,) int64 and xyz (M, 3) float64: tracked points that moved,
    world frame; may be empty.
    """

    index: NDArray[np.int64]
    T_camera_world: NDArray[np.float64]
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    xyz: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        n, m = len(self.index), len(self.ids)
        if n == 0 or self.T_camera_world.shape != (n, 4, 4) or not np.isfinite(self.T_camera_world).all():
            raise ValueError(f"a correction needs finite poses ({n}, 4, 4), not {self.T_camera_world.shape}")
        if (np.diff(self.index) <= 0).any() or self.index[0] < 0:
            raise ValueError("frames of a correction must be named once each, in their order")
        if self.xyz.shape != (m, 3) or not np.isfinite(self.xyz).all():
            raise ValueError(f"a correction's points must be finite ({m}, 3), not {self.xyz.shape}")
