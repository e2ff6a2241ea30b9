"""The child's queue between its tracker and the mapper."""

from __future__ import annotations

from collections import deque
from threading import Condition

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.inputs.tracking_process.frame_record import FrameRecord
from modp_ti.inputs.tracking_process.messages import CameraRevised, Ended

__all__ = ["LIMIT", "ROOM", "Outbox"]

# Events that may wait for the mapper. A frame without its image takes some 15 KB.
LIMIT = 2000
# Memory of the images of waiting frames [bytes], for example of 140 frames of 320x240. Reading an image again takes a
# third of the time of tracking it, on the same core: with room for four, a stream of 30 frames a second fell behind.
ROOM = 128 << 20

_Message = PoseCorrection | CameraRevised | Ended


class Outbox:
    """Queue of frames and corrections, in order.

    Waiting frames keep their images while these fit into `room`. The images of the others are read again when it is
    their turn. The tracker is not held up before `LIMIT` events wait.

    Args:
        room: Memory of the images [bytes]. One frame keeps its image in any case.
    """

    def __init__(self, room: int = ROOM) -> None:
        self._room = room
        self._taken = 0
        self._events: deque[TrackedFrame | FrameRecord | _Message] = deque()
        self._changed = Condition()

    def put(self, event: TrackedFrame | _Message) -> None:
        """Append an event; wait while the queue is full."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._events) < LIMIT)
            if not isinstance(event, TrackedFrame):
                self._events.append(event)
            elif self._taken == 0 or self._taken + event.image.nbytes <= self._room:
                self._taken += event.image.nbytes
                self._events.append(event)
            else:
                self._events.append(FrameRecord.of(event))
            self._changed.notify_all()

    def get(self) -> TrackedFrame | FrameRecord | _Message:
        """Take the first event; wait for it."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._events) > 0)
            event = self._events.popleft()
            if isinstance(event, TrackedFrame):
                self._taken -= event.image.nbytes
            self._changed.notify_all()
            return event
