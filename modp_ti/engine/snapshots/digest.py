"""A checksum of what a tracker has delivered, by which a resumed run knows that it is given the same again."""

from __future__ import annotations

import zlib

import numpy as np

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame

__all__ = ["StreamDigest"]


class StreamDigest:
    """value: CRC-32 of all frames and corrections so far, in their order; events: how many."""

    def __init__(self) -> None:
        self.value = 0
        self.events = 0

    def add(self, event: TrackedFrame | PoseCorrection) -> None:
        """Take in the next one. Of a held-out frame the image does not count, for it does not touch the map."""
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
            self.value = zlib.crc32(np.ascontiguousarray(array), self.value)
