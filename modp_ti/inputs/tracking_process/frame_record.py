"""`FrameRecord`: a frame without its image, which travels beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.sources import Picture

__all__ = ["FrameRecord"]


@dataclass(frozen=True)
class FrameRecord:
    """A `TrackedFrame` without its image, mask and vignette. The attributes are those of the frame."""

    index: int
    timestamp: float
    name: str
    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]
    points: SparsePoints
    held_out: bool
    arrived: float | None

    @classmethod
    def of(cls, frame: TrackedFrame) -> FrameRecord:
        return cls(
            frame.index,
            frame.timestamp,
            frame.name,
            frame.camera,
            frame.T_camera_world,
            frame.points,
            frame.held_out,
            frame.arrived,
        )

    def with_picture(self, picture: Picture) -> TrackedFrame:
        """Return the frame with an image that was read (again)."""
        return TrackedFrame(
            index=self.index,
            timestamp=self.timestamp,
            name=self.name,
            image=picture.image,
            camera=self.camera,
            T_camera_world=self.T_camera_world,
            points=self.points,
            mask=picture.mask,
            vignette=picture.vignette,
            held_out=self.held_out,
            arrived=self.arrived,
        )
