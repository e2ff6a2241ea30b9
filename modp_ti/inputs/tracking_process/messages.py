"""What the two processes tell each other through the pipe. Images travel through the `FrameRing`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.sources import Intrinsics, Picture
from modp_ti.inputs.tracking_process.frame_ring import SlotLayout

__all__ = ["CameraRevised", "Delivered", "Ended", "FrameRecord", "Job", "Opened", "Preparing", "RingMade"]


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

    def with_pose(self, T_camera_world: NDArray[np.float64], points: SparsePoints) -> FrameRecord:
        return replace(self, T_camera_world=T_camera_world, points=points)

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


@dataclass(frozen=True)
class Job:
    """To the child: what to track. A live source stores its frames in `folder`, which belongs to the parent."""

    config: SceneConfig
    folder: Path | None


@dataclass(frozen=True)
class Preparing:
    """Progress while the tracker is opened, as for `Progress`."""

    what: str
    done: int
    total: int


@dataclass(frozen=True)
class Opened:
    """The tracker is open."""

    notes: list[str]
    scale: float
    intrinsics: Intrinsics


@dataclass(frozen=True)
class CameraRevised:
    """The correction that follows, and all frames after it, have another camera.

    Attributes:
        intrinsics: The camera of the stored images.
    """

    intrinsics: Intrinsics


@dataclass(frozen=True)
class RingMade:
    """The ring has its size, which the first frame determines. The vignette is that of all frames of a camera."""

    layout: SlotLayout
    vignette: NDArray[np.float32] | None


@dataclass(frozen=True)
class Delivered:
    """A frame is in a slot of the ring. The parent answers with the slot's number when it has copied it."""

    slot: int
    record: FrameRecord
    masked: bool


@dataclass(frozen=True)
class Ended:
    """The stream has ended, by an error of the input or a failure of the tracker if one is given."""

    notes: list[str]
    unreadable: Mapping[str, UnreadableImageError]
    error: InputError | None = None
    failure: str | None = None
