"""`TrackedFrame`: what a tracker hands to the mapper, and the only thing that the mapper takes in."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fields.camera import PinholeCamera
from fields.pyramid import ImageLevel, build_pyramid

__all__ = ["SparsePoints", "TrackedFrame"]


def _empty(*shape: int) -> NDArray[np.float64]:
    return np.zeros(shape, dtype=np.float64)


@dataclass(frozen=True)
class SparsePoints:
    """Tracked 3D points observed in one frame (P_i of the paper).

    xyz: (N, 3) float64, world frame. pixels: (N, 2) float64, (x, y) observed in the undistorted image, pixel
    centres at +0.5. ids: (N,) int64, the same number for the same point in every frame.
    """

    xyz: NDArray[np.float64] = field(default_factory=lambda: _empty(0, 3))
    pixels: NDArray[np.float64] = field(default_factory=lambda: _empty(0, 2))
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        n = len(self.ids)
        if self.xyz.shape != (n, 3) or self.pixels.shape != (n, 2):
            raise ValueError(
                f"sparse points disagree in number: xyz {self.xyz.shape}, pixels {self.pixels.shape}, ids ({n},)"
            )
        if not (np.isfinite(self.xyz).all() and np.isfinite(self.pixels).all()):
            raise ValueError("sparse points hold NaN or infinite values")

    def __len__(self) -> int:
        return len(self.ids)

    def depths(self, T_camera_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth (N,) of the points before a camera at this pose; negative behind it."""
        return self.xyz @ T_camera_world[2, :3] + T_camera_world[2, 3]


@dataclass(frozen=True)
class TrackedFrame:
    """One frame with its tracked pose.

    index: position among the frames that the tracker delivered, from 0. timestamp: seconds.
    image: (H, W, 3) float32 RGB in [0, 1], undistorted. camera: its intrinsics.
    T_camera_world: (4, 4) float64, world to camera, OpenCV axes.
    mask: (H, W) bool, True where the pixel is valid; None where all are.
    vignette: (H, W, 3) float32 in (0, 1], the share of the light that reaches each pixel, one array for all frames of
    a camera; None for all of it. The image shows the scene times the vignette.
    held_out: only for evaluation; such a frame never touches the map.

    `rgba` and `pyramid` are made when first asked for, which a thread may do before the mapper takes the frame in.
    """

    index: int
    timestamp: float
    name: str
    image: NDArray[np.float32]
    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]
    points: SparsePoints = field(default_factory=SparsePoints)
    mask: NDArray[np.bool_] | None = None
    vignette: NDArray[np.float32] | None = None
    held_out: bool = False

    def __post_init__(self) -> None:
        expected = (self.camera.height, self.camera.width)
        if self.image.shape != (*expected, 3) or self.image.dtype != np.float32:
            raise ValueError(
                f"{self.name}: image is {self.image.shape} {self.image.dtype}, "
                f"the camera asks for {(*expected, 3)} float32"
            )
        if self.mask is not None and self.mask.shape != expected:
            raise ValueError(f"{self.name}: mask is {self.mask.shape}, the image {expected}")
        if self.vignette is not None and self.vignette.shape != self.image.shape:
            raise ValueError(f"{self.name}: vignette is {self.vignette.shape}, the image {self.image.shape}")
        if self.T_camera_world.shape != (4, 4) or not np.isfinite(self.T_camera_world).all():
            raise ValueError(f"{self.name}: T_camera_world must be a finite 4x4 matrix")

    @cached_property
    def rgba(self) -> NDArray[np.uint8]:
        """The image with 8 bits a channel (H, W, 4), 255 in the last where the pixel is valid and all 0 where not."""
        rgba = np.full((*self.image.shape[:2], 4), 255, dtype=np.uint8)
        rgba[..., :3] = np.round(self.image * 255.0)
        if self.mask is not None:
            rgba[~self.mask] = 0
        return rgba

    @cached_property
    def pyramid(self) -> tuple[ImageLevel, ...]:
        """`rgba` and its halved sizes, as many levels as `build_pyramid` makes."""
        return build_pyramid(self.rgba, self.camera)
