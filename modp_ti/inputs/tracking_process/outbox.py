"""The child's queue between its tracker and the mapper."""

from __future__ import annotations

from collections import deque
from threading import Condition

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.inputs.tracking_process.messages import CameraRevised, Ended, FrameRecord

__all__ = ["LIMIT", "Outbox"]

# Events that may wait for the mapper. A frame without its image takes some 15 KB.
LIMIT = 2000

_Message = PoseCorrection | CameraRevised | Ended


class Outbox:
    """Queue of frames and corrections, in order.

    Only the first `pictures` waiting frames keep their images. The images of the others are read again when it is their
    turn. The tracker is not held up before `LIMIT` events wait.

    Args:
        pictures: Number of frames that wait with their images.
    """

    def __init__(self, pictures: int) -> None:
        self._pictures = pictures
        self._with_picture = 0
        self._events: deque[TrackedFrame | FrameRecord | _Message] = deque()
        self._changed = Condition()

    def put(self, event: TrackedFrame | _Message) -> None:
        """Append an event; wait while the queue is full."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._events) < LIMIT)
            if not isinstance(event, TrackedFrame):
                self._events.append(event)
            elif self._with_picture < self._pictures:
                self._with_picture += 1
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
                self._with_picture -= 1
            self._changed.notify_all()
            return event
