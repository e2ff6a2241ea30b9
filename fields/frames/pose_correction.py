"""`PoseCorrection`: a tracker's revision of poses that it delivered earlier."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fields.frames.camera_revision import CameraRevision


@dataclass(frozen=True)
class PoseCorrection:
    """Revised poses and points after a bundle adjustment or a loop closure, and the camera if it was estimated anew.

    Frames that are not listed follow the listed frames around them, or keep their poses with `others_stay`. A new
    camera is that of all frames, those after the correction included.

    One frame may be given by its index and pose (4, 4), and numbers in any form that NumPy takes.

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
        mapper.correct(modp_ti.PoseCorrection(1, T_camera_world))
        mapper.correct(modp_ti.PoseCorrection([0, 1], [np.eye(4), T_camera_world]))
    """

    index: NDArray[np.int64]
    T_camera_world: NDArray[np.float64]
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    xyz: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    camera: CameraRevision | None = None
    others_stay: bool = False

    if TYPE_CHECKING:  # what the generated one takes, before `__post_init__` converts it

        def __init__(
            self,
            index: ArrayLike,
            T_camera_world: ArrayLike,
            ids: ArrayLike = ...,
            xyz: ArrayLike = ...,
            camera: CameraRevision | None = None,
            others_stay: bool = False,
        ) -> None: ...

    def __post_init__(self) -> None:
        T, xyz = (np.asarray(array, dtype=np.float64) for array in (self.T_camera_world, self.xyz))
        arrays = {"T_camera_world": T[None] if T.shape == (4, 4) else T, "xyz": xyz if xyz.size else xyz.reshape(-1, 3)}
        for name, given in (("index", self.index), ("ids", self.ids)):
            numbers = np.atleast_1d(given)
            if numbers.ndim != 1 or (numbers.size and numbers.dtype.kind not in "iu"):
                raise ValueError(f"{name} of a correction must be integers (N,), not {numbers.shape} {numbers.dtype}")
            arrays[name] = numbers.astype(np.int64, copy=False)
        for name, array in arrays.items():
            object.__setattr__(self, name, array)
        n, m = len(self.index), len(self.ids)
        if n == 0 or self.T_camera_world.shape != (n, 4, 4) or not np.isfinite(self.T_camera_world).all():
            raise ValueError(f"a correction needs finite poses ({n}, 4, 4), not {self.T_camera_world.shape}")
        if (np.diff(self.index) <= 0).any() or self.index[0] < 0:
            raise ValueError("frames of a correction must be named once each, in their order")
        if self.xyz.shape != (m, 3) or not np.isfinite(self.xyz).all():
            raise ValueError(f"a correction's points must be finite ({m}, 3), not {self.xyz.shape}")
