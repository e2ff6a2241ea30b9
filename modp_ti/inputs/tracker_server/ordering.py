"""Puts frames and corrections in order and holds frames back until their poses are known."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from fields.frames.tracked_frame import SparsePoints
from modp_ti.inputs.tracker_server.messages import Correction, Frame, ProtocolError, State, UnfitError

# Limits of what may wait behind a frame without a pose. Images wait on disk.
MAX_WAITING = 2_000  # frames and corrections
MAX_WAITING_BYTES = 256 << 20  # bytes of points and poses
MAX_WAITING_IMAGES = 4 << 30  # bytes of images on disk
# Corrections between two frames. Each one costs time proportional to all frames so far.
MAX_CORRECTIONS = 100


class Ordering:
    """Receives messages as they arrive, and yields posed frames and corrections in the order in which they were sent.

    A frame whose pose comes later delays everything after it. Lost frames are skipped.

    Attributes:
        lost: Number of frames that were skipped because they have no pose.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._waiting: deque[Frame | Correction] = deque()
        self._late: dict[int, Frame] = {}  # POSE messages of frames that are not delivered yet
        self._undecided: set[int] = set()
        self._posed: set[int] = set()
        self._left_out: set[int] = set()
        self._bytes = 0
        self._images: deque[int] = deque()  # image sizes in bytes of the waiting frames
        self._corrections = 0  # since the last frame
        self._last: Frame | None = None

    @property
    def begun(self) -> bool:
        """Whether a frame has arrived."""
        return self._last is not None

    def require_next(self, frame: Frame) -> None:
        """Raise UnfitError unless the frame's number and time stamp exceed those of the last frame."""
        if self._last is None:
            return
        if frame.number <= self._last.number:
            raise UnfitError(f"FRAME {frame.number} after FRAME {self._last.number}: numbers must grow")
        if frame.timestamp <= self._last.timestamp:
            raise UnfitError(
                f"FRAME {frame.number}: its time {frame.timestamp!r} is not after {self._last.timestamp!r}, that of "
                f"FRAME {self._last.number}",
                frame.number,
            )

    def add_frame(self, frame: Frame) -> None:
        """Add a frame; only the size of its image is kept.

        Raises:
            UnfitError: As for `require_next`.
            ProtocolError: If too much waits for a pose.
        """
        self.require_next(frame)
        self._corrections = 0
        self._left_out.discard(frame.number)
        self._images.append(len(frame.image))
        self._last = frame = replace(frame, image=b"")
        if frame.state is State.LATER:
            self._undecided.add(frame.number)
        elif frame.state is State.KNOWN:
            self._posed.add(frame.number)
        self._wait(frame)

    def add_pose(self, pose: Frame) -> None:
        """Add the pose of a frame that was sent without one, or the fact that it is lost.

        Raises:
            ProtocolError: If no such frame waits for its pose, or too much waits for a pose.
        """
        if pose.number in self._left_out:
            return
        if pose.number not in self._undecided:
            raise ProtocolError(
                f"POSE {pose.number}: no frame of this number waits for its pose; CORRECTION revises one that has it"
            )
        self._undecided.discard(pose.number)
        if pose.state is State.KNOWN:
            self._posed.add(pose.number)
        self._late[pose.number] = pose
        self._hold(_size(pose))

    def add_correction(self, correction: Correction) -> None:
        """Add a correction. Skipped frames are removed from it.

        Raises:
            UnfitError: If it contains a frame without a pose.
            ProtocolError: If there are too many corrections without a frame between them, or too much waits for a pose.
        """
        self._corrections += 1
        if self._corrections > MAX_CORRECTIONS:
            raise ProtocolError(f"more than {MAX_CORRECTIONS} CORRECTIONs without a FRAME between them: send fewer")
        heard = np.array([number not in self._left_out for number in correction.numbers.tolist()])
        if not heard.any():
            return
        numbers = correction.numbers[heard]
        for number in numbers.tolist():
            if number not in self._posed:
                raise UnfitError(f"CORRECTION of frame {number}, which has no pose so far")
        self._wait(replace(correction, numbers=numbers, T_camera_world=correction.T_camera_world[heard]))

    def leave_out(self, number: int) -> None:
        """Skip a frame without a usable pose or image, and ignore later messages about it.

        Frames that already have a pose are not affected.
        """
        if number in self._posed:
            return
        self._left_out.add(number)
        if number in self._undecided:
            self._undecided.discard(number)
            self._late[number] = Frame(number, State.LOST, 0.0, None, SparsePoints(), b"")

    def ready(self) -> Iterator[Frame | Correction]:
        """Yield the frames with known poses, and the corrections, that no earlier frame without a pose delays."""
        while self._waiting:
            item = self._waiting[0]
            if isinstance(item, Frame) and item.state is State.LATER:
                if item.number not in self._late:
                    return
                late = self._late.pop(item.number)
                self._bytes -= _size(late)
                item = replace(late, timestamp=item.timestamp)
            else:
                self._bytes -= _size(item)
            self._waiting.popleft()
            if isinstance(item, Frame):
                self._images.popleft()
            if isinstance(item, Frame) and item.state is State.LOST:
                self.lost += 1
            else:
                yield item

    def close(self) -> None:
        """End the stream: frames that still wait for a pose become lost."""
        for item in self._waiting:
            if isinstance(item, Frame) and item.number in self._undecided:
                self._late[item.number] = replace(item, state=State.LOST)
        self._undecided.clear()

    def _wait(self, item: Frame | Correction) -> None:
        self._waiting.append(item)
        self._hold(_size(item))

    def _hold(self, size: int) -> None:
        self._bytes += size
        images = sum(self._images)
        if len(self._waiting) > MAX_WAITING or self._bytes > MAX_WAITING_BYTES or images > MAX_WAITING_IMAGES:
            size = self._bytes + images >> 20
            raise ProtocolError(
                f"{len(self._waiting)} frames and corrections ({size} MiB) wait for the pose of FRAME "
                f"{min(self._undecided, default=0)}: send its POSE, state 2 where it has none"
            )


def _size(item: Frame | Correction) -> int:
    """Approximate memory of a message in bytes."""
    return 48 * len(item.points) if isinstance(item, Frame) else 136 * len(item.numbers) + 32 * len(item.ids)
