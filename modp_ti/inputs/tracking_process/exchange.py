"""What the two processes exchange: messages through the pipe, and frames and counts in shared memory."""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import ImageLevel, TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.frame_record import FrameRecord
from modp_ti.inputs.protocol import LiveCounts
from modp_ti.inputs.sources import Intrinsics, Picture

# Numbers of a `CountsBoard`: the counts, the number of frames, the wish to finish, and whether the stream goes on.
NUMBERS = 8

# ---- the pipe --------------------------------------------------------------------------------------------------------


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
    camera: PinholeCamera
    masked: bool


@dataclass(frozen=True)
class Ended:
    """The stream has ended, by an error of the input or a failure of the tracker if one is given."""

    notes: list[str]
    unreadable: Mapping[str, UnreadableImageError]
    error: InputError | None = None
    failure: str | None = None


# ---- shared memory ---------------------------------------------------------------------------------------------------


def anonymous_memory() -> int:
    """Return the descriptor of a new empty memory without a name.

    The system frees it with the last process that holds it, however that process ends.
    """
    if hasattr(os, "memfd_create"):
        return os.memfd_create("modp-ti-frames")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


@dataclass(frozen=True)
class SlotLayout:
    """Sizes of the arrays of a frame in a slot.

    Attributes:
        width: Image width [px].
        height: Image height [px].
        levels: (width, height) of each level of the image pyramid.
    """

    width: int
    height: int
    levels: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, frame: TrackedFrame) -> SlotLayout:
        levels = tuple((level.camera.width, level.camera.height) for level in frame.pyramid)
        return cls(frame.camera.width, frame.camera.height, levels)

    @property
    def bytes(self) -> int:
        """Size of a slot: the image as float32, the levels of the pyramid, and the mask."""
        pixels = self.width * self.height
        return 12 * pixels + sum(4 * width * height for width, height in self.levels) + pixels


class FrameRing:
    """Slots in shared memory, each for one frame. Both processes map the same memory.

    Who may use which slot is agreed upon by messages; the ring itself does not lock.

    Args:
        memory: Descriptor of the memory, see `anonymous_memory`. It grows to the size that is needed.
        layout: Layout of a slot.
        slots: Number of slots.
    """

    def __init__(self, memory: int, layout: SlotLayout, slots: int) -> None:
        self.layout = layout
        size = layout.bytes * slots
        if os.fstat(memory).st_size < size:
            os.ftruncate(memory, size)
        self._map = mmap.mmap(memory, size)

    def write(self, slot: int, frame: TrackedFrame) -> None:
        """Copy the arrays of a frame to a slot.

        Raises:
            InputError: If the frame has another size than the ring's.
        """
        if SlotLayout.of(frame) != self.layout:
            raise InputError(
                f"{frame.name} is {frame.camera.width}x{frame.camera.height}, the first frame "
                f"{self.layout.width}x{self.layout.height}: all images of a scene must have one size"
            )
        image, levels, mask = self._arrays(slot)
        np.copyto(image, frame.image)
        for level, here in zip(frame.pyramid, levels, strict=True):
            np.copyto(here, level.rgba)
        if frame.mask is not None:
            np.copyto(mask, frame.mask)

    def read(self, sent: Delivered, vignette: NDArray[np.float32] | None) -> TrackedFrame:
        """Return a frame in its slot, given its message and vignette. Its arrays are copies."""
        image, levels, mask = self._arrays(sent.slot)
        picture = Picture(image.copy(), mask.copy() if sent.masked else None, vignette, sent.camera)
        frame, pyramid, camera = sent.record.with_picture(picture), [], sent.camera
        for level in levels:
            height, width = level.shape[:2]
            camera = camera if (width, height) == (camera.width, camera.height) else camera.resized(width, height)
            pyramid.append(ImageLevel(level.copy(), camera))
        # What the properties of these names have cached in the other process.
        frame.__dict__.update(rgba=pyramid[0].rgba, pyramid=tuple(pyramid))
        return frame

    def _arrays(self, slot: int) -> tuple[NDArray[np.float32], list[NDArray[np.uint8]], NDArray[np.bool_]]:
        """Views of a slot: image (H, W, 3), levels (H_l, W_l, 4) and mask (H, W)."""
        layout, at = self.layout, slot * self.layout.bytes

        def view(dtype: type, *shape: int) -> NDArray:
            nonlocal at
            array = np.frombuffer(self._map, dtype, int(np.prod(shape)), at).reshape(shape)
            at += array.nbytes
            return array

        image = view(np.float32, layout.height, layout.width, 3)
        levels = [view(np.uint8, height, width, 4) for width, height in layout.levels]
        return image, levels, view(np.bool_, layout.height, layout.width)


class CountsBoard:
    """Counts of the stream in shared memory and whether it goes on, written by the child; the parent's wish to end it.

    Each number is read and written at once, without locks.

    Args:
        memory: Descriptor of the memory, see `anonymous_memory`.
    """

    def __init__(self, memory: int) -> None:
        os.ftruncate(memory, 8 * NUMBERS)
        self._numbers = np.frombuffer(mmap.mmap(memory, 8 * NUMBERS), np.float64)

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
