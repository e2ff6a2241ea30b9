"""What the two processes tell each other through the pipe. Images travel through the `FrameRing`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.sources import Intrinsics
from modp_ti.inputs.tracking_process.frame_record import FrameRecord
from modp_ti.inputs.tracking_process.frame_ring import SlotLayout

__all__ = ["CameraRevised", "Delivered", "Ended", "Job", "Opened", "Preparing", "RingMade"]


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
