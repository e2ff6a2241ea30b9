"""The delivered frames with their corrected poses and points."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints
from fields.geometry.se3 import interpolate_se3, inverse_se3
from modp_ti.inputs.replay import PosedImage

__all__ = ["History"]


class History:
    """Delivered frames in order, with all corrections applied. Their images and points are stored on disk."""

    def __init__(self) -> None:
        self.frames: list[PosedImage] = []
        self._moved: dict[int, NDArray[np.float64]] = {}
        self._known: set[int] = set()

    def add(self, frame: PosedImage) -> None:
        """Add a delivered frame. Only the ids of its points are kept."""
        ids = frame.points.ids.tolist()
        self._known.update(ids)
        for i in ids:  # a later frame's position of a point is newer than an earlier correction
            self._moved.pop(i, None)
        self.frames.append(frame.with_points(SparsePoints()))

    def correct(self, correction: PoseCorrection) -> None:
        """Apply a correction.

        A frame without a corrected pose moves with the interpolated motion of the nearest corrected frames before and
        after it, or with the motion of the nearest one where only one side has one.
        """
        named = correction.index.tolist()
        motions = [
            inverse_se3(self.frames[i].T_camera_world) @ T
            for i, T in zip(named, correction.T_camera_world, strict=True)
        ]
        given = dict(zip(named, correction.T_camera_world, strict=True))
        for i, frame in enumerate(self.frames):
            if i in given:
                pose = given[i]
            else:
                after = bisect_left(named, i)
                if after in (0, len(named)):
                    motion = motions[min(after, len(named) - 1)]
                else:
                    a, b = named[after - 1], named[after]
                    motion = interpolate_se3(motions[after - 1], motions[after], (i - a) / (b - a))
                pose = frame.T_camera_world @ motion
            self.frames[i] = replace(frame, T_camera_world=pose)
        for i, xyz in zip(correction.ids.tolist(), correction.xyz, strict=True):
            if i in self._known:
                self._moved[i] = xyz

    def placed(self, points: SparsePoints) -> SparsePoints:
        """Replace the positions of a frame's points with the corrected ones."""
        if not self._moved:
            return points
        pairs = zip(points.ids.tolist(), points.xyz, strict=True)
        xyz = np.array([self._moved.get(i, old) for i, old in pairs]).reshape(-1, 3)
        return replace(points, xyz=xyz)
