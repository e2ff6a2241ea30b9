"""The frames that the tracker's process has delivered, with their latest poses and points."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from typing import IO

import numpy as np

from fields.frames.camera_revision import CameraRevision
from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints
from modp_ti.inputs.tracking_process.frame_record import FrameRecord

__all__ = ["DeliveredLog"]

POINT = np.dtype([("id", "i8"), ("xyz", "f8", 3), ("pixel", "f8", 2)])


class DeliveredLog:
    """Records of the delivered frames in order, with all corrections applied.

    Only the frames that a correction lists move, as `PoseCorrection.others_stay` says for those of `klt`. The points
    are kept in a file without a name. Their ids count from 0, as those of `klt`.

    Attributes:
        records: The records without their points.
    """

    def __init__(self) -> None:
        self.records: list[FrameRecord] = []
        self._counts: list[int] = []
        # Without a buffer, so that what a full disk refuses is known at once.
        self._points: IO[bytes] = tempfile.TemporaryFile(buffering=0)
        self._size = 0  # bytes of the points
        self._moved = np.zeros((0, 3))  # by id, NaN for points that were not corrected
        self._revisions: list[tuple[int, CameraRevision]] = []  # with the number of frames before each

    def __len__(self) -> int:
        return len(self.records)

    def add(self, record: FrameRecord) -> None:
        """Add a delivered frame. Raises OSError if the disk is full."""
        points = record.points
        table = np.zeros(len(points), POINT)
        table["id"], table["xyz"], table["pixel"] = points.ids, points.xyz, points.pixels
        self._points.seek(self._size)
        if self._points.write(table.tobytes()) < table.nbytes:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._size += table.nbytes
        self.records.append(record.with_pose(record.T_camera_world, SparsePoints()))
        self._counts.append(len(points))

    def correct(self, correction: PoseCorrection) -> None:
        """Apply a correction."""
        for index, T in zip(correction.index.tolist(), correction.T_camera_world, strict=True):
            record = self.records[index]
            self.records[index] = record.with_pose(T, record.points)
        if len(correction.ids) and correction.ids.max() >= len(self._moved):
            more = max(int(correction.ids.max()) + 1, 2 * len(self._moved)) - len(self._moved)
            self._moved = np.concatenate([self._moved, np.full((more, 3), np.nan)])
        self._moved[correction.ids] = correction.xyz
        if correction.camera is not None:
            self._revisions.append((len(self), correction.camera))
            self.records = [replace(record, camera=correction.camera.camera) for record in self.records]

    def __iter__(self) -> Iterator[FrameRecord]:
        at = 0
        for number, (record, count) in enumerate(zip(self.records, self._counts, strict=True)):
            self._points.seek(at)
            data = self._points.read(count * POINT.itemsize)
            at += len(data)
            table = np.frombuffer(data, POINT)
            xyz, pixels, ids = table["xyz"].copy(), table["pixel"].copy(), table["id"].copy()
            here = np.flatnonzero(ids < len(self._moved))
            here = here[~np.isnan(self._moved[ids[here], 0])]
            xyz[here] = self._moved[ids[here]]
            for before, revision in self._revisions:
                if number < before:
                    pixels = revision.pixels(pixels)
            seen = record.camera.contains(pixels)
            points = SparsePoints(xyz[seen], pixels[seen], ids[seen])
            yield record.with_pose(record.T_camera_world, points)

    def close(self) -> None:
        self._points.close()
