"""A checksum of the tracker's output. A resumed run uses it to verify that it receives the same input again."""

from __future__ import annotations

import zlib

import numpy as np

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame

__all__ = ["StreamDigest"]


class StreamDigest:
    """Checksum of frames and corrections.

    Attributes:
        value: CRC-32 of all frames and corrections so far, in order.
        events: Their number.
    """

    def __init__(self) -> None:
        self.value = 0
        self.events = 0

    def add(self, event: TrackedFrame | PoseCorrection) -> None:
        """Add a frame or correction. The image of a held-out frame is left out, as it does not affect the map."""
        self.events += 1
        if isinstance(event, PoseCorrection):
            self._take(event.index, event.T_camera_world, event.ids, event.xyz)
            return
        camera, points = event.camera, event.points
        self.value = zlib.crc32(event.name.encode("utf-8"), self.value)
        numbers = [event.index, event.timestamp, camera.fx, camera.fy, camera.cx, camera.cy]
        self._take(np.array(numbers, dtype=np.float64), event.T_camera_world, points.xyz, points.pixels, points.ids)
        if not event.held_out:
            self._take(event.rgba)

    def _take(self, *arrays: np.ndarray) -> None:
        for array in arrays:
            self.value = zlib.crc32(np.ascontiguousarray(array).data, self.value)
