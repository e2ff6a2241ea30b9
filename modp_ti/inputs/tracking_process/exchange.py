"""What the two processes exchange: messages through the pipe, and counts in shared memory.

Frames and corrections go through the pipe as they are, with the image pyramids that the other process has built.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.protocol import LiveCounts
from modp_ti.inputs.source_settings import Scene
from modp_ti.inputs.sources import Intrinsics

# Numbers of a `CountsBoard`: the counts, the number of frames, the wish to finish, and whether the stream goes on.
NUMBERS = 8


@dataclass(frozen=True)
class Job:
    """To the child: what to track. A live source stores its frames in `folder`, which belongs to the parent."""

    config: Scene
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
class Vignette:
    """The vignette of the frames that follow, which come without it: one array for all frames of a camera."""

    vignette: NDArray[np.float32] | None


@dataclass(frozen=True)
class Ended:
    """The stream has ended, by an error of the input or a failure of the tracker if one is given."""

    notes: list[str]
    unreadable: Mapping[str, UnreadableImageError]
    error: InputError | None = None
    failure: str | None = None


def with_vignette(frame: TrackedFrame, vignette: NDArray[np.float32] | None) -> TrackedFrame:
    """Return a frame with another vignette, and with the pyramid that it has built."""
    other = copy(frame)
    vars(other)["vignette"] = vignette
    return other


class CountsBoard:
    """Counts of the stream in shared memory and whether it goes on, written by the child; the parent's wish to end it.

    Each number is read and written at once, without locks.

    Args:
        file: Descriptor of a temporary file that both processes map.
    """

    def __init__(self, file: int) -> None:
        os.ftruncate(file, 8 * NUMBERS)
        self._numbers = np.frombuffer(mmap.mmap(file, 8 * NUMBERS), np.float64)

    def write(self, counts: LiveCounts | None, frame_count: int | None) -> None:
        if counts is not None:
            self._numbers[:5] = counts.arrived, counts.tracked, counts.thinned, counts.lost, counts.newest
        self._numbers[5] = -1 if frame_count is None else frame_count

    def counts(self, delivered: int) -> LiveCounts:
        """Return the counts, of which the parent has taken `delivered` frames."""
        arrived, tracked, thinned, lost = (int(number) for number in self._numbers[:4])
        return LiveCounts(arrived, tracked, thinned, lost, max(0, tracked - delivered), float(self._numbers[4]))

    @property
    def frame_count(self) -> int | None:
        return None if self._numbers[5] < 0 else int(self._numbers[5])

    @property
    def recording(self) -> bool:
        """Whether images still arrive."""
        return bool(self._numbers[7])

    @recording.setter
    def recording(self, goes_on: bool) -> None:
        self._numbers[7] = goes_on

    @property
    def finish(self) -> bool:
        """Whether the parent wants the recording to end. Setting it is safe in a signal handler."""
        return bool(self._numbers[6])

    @finish.setter
    def finish(self, wanted: bool) -> None:
        self._numbers[6] = wanted
