"""A tracker's revision of what it delivered earlier: `PoseCorrection` of poses and points, `CameraRevision`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fields.geometry.camera import PinholeCamera

# Steps of the fixed-point iteration that inverts the lookup. Each divides the error by two or more for usual lenses.
INVERSION_STEPS = 12


@dataclass(frozen=True)
class CameraRevision:
    """A new camera with new lens distortion, and how images of the former one become images of the new one.

    Attributes:
        camera: Intrinsics of the new images, which have the size of the former ones.
        lookup: Positions (H, W, 2) float64 in the former image, as (x, y) with pixel centres at +0.5, of the pixels of
            the new image. None if the images stay the same, as when the focal length changes alone.
        covered: Pixels (H, W) bool of the new image that the lens can have seen; None for all.

    Raises:
        ValueError: If the shapes disagree or a position is not finite.
    """

    camera: PinholeCamera
    lookup: NDArray[np.float64] | None = None
    covered: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        size = self.camera.height, self.camera.width
        if self.lookup is not None and (self.lookup.shape != (*size, 2) or not np.isfinite(self.lookup).all()):
            raise ValueError(f"the lookup of a camera's revision must be finite {(*size, 2)}, not {self.lookup.shape}")
        if self.covered is not None and self.covered.shape != size:
            raise ValueError(f"the covered pixels of a camera's revision are {self.covered.shape}, the image {size}")

    def pixels(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """Map pixels (N, 2) of the former image to the new one. Outside the image, the shift at its border is used."""
        before = np.asarray(pixels, dtype=np.float64)
        if self.lookup is None or len(before) == 0:
            return before.copy()
        inside = np.clip(before, 0.0, (self.camera.width, self.camera.height))
        after = inside.copy()
        for _ in range(INVERSION_STEPS):
            after += inside - _sampled(self.lookup, after)
        return before + (after - inside)

    def points(self, points_camera: NDArray[np.floating], before: PinholeCamera) -> NDArray[np.float64]:
        """Move points (N, 3) in the frame of the former camera onto the new rays of their pixels. Their depths stay.

        Points that are not in front of the camera stay.
        """
        moved = np.array(points_camera, dtype=np.float64)
        front = moved[:, 2] > 0
        there = moved[front]
        moved[front] = self.camera.unproject(self.pixels(before.project(there)), there[:, 2])
        return moved

    def image(self, rgba: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Map an image (H, W, 4) of the former camera, with 255 at valid pixels in the last channel, to the new one.

        As in the reader, invalid pixels do not contribute, and a pixel is invalid if more than half of its weight is.
        """
        if self.lookup is None:
            return rgba
        x, y = self._cv2_maps(self.lookup)
        valid = rgba[..., 3] > 0
        inside = self.camera.contains(self.lookup.reshape(-1, 2)).reshape(valid.shape)
        if self.covered is not None:
            inside &= self.covered
        new = np.full_like(rgba, 255)
        if valid.all():
            new[..., :3] = cv2.remap(rgba[..., :3], x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        else:
            both = np.dstack([np.where(valid[..., None], rgba[..., :3], 0), valid]).astype(np.float32)
            both = cv2.remap(both, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            share = both[..., 3]
            new[..., :3] = np.round(np.clip(both[..., :3] / np.maximum(share, 0.5)[..., None], 0.0, 255.0))
            inside &= share >= 0.5
        new[~inside] = 0
        return new

    def vignette(self, vignette: NDArray[np.float32]) -> NDArray[np.float32]:
        """Map the vignette (H, W, 3) of images of the former camera to the new one."""
        if self.lookup is None:
            return vignette
        x, y = self._cv2_maps(self.lookup)
        new = np.asarray(cv2.remap(vignette, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.float32)
        new.flags.writeable = False  # shared by all frames
        return new

    @staticmethod
    def _cv2_maps(lookup: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        maps = (lookup - 0.5).astype(np.float32)
        return np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])


def _sampled(grid: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interpolate a grid (H, W, 2) of values at pixel centres linearly at pixels (N, 2), also beyond its border."""
    height, width = grid.shape[:2]
    at = pixels - 0.5
    low = np.clip(np.floor(at).astype(np.int64), 0, (max(width - 2, 0), max(height - 2, 0)))
    right, down = (at - low).T[..., None]
    x, y = low.T
    x1, y1 = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    above = (1.0 - right) * grid[y, x] + right * grid[y, x1]
    return (1.0 - down) * above + down * ((1.0 - right) * grid[y1, x] + right * grid[y1, x1])


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
