"""The tracked points of a run and where its frames saw them: what is kept for the exports."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.tracked_frame import TrackedFrame

__all__ = ["TrackedPoints"]

# Of a point that only held-out frames saw: their pictures must not come into what is trained on elsewhere.
UNSEEN = (128, 128, 128)


class TrackedPoints:
    """Points by the tracker's ids; 16 bytes an observation, 56 a point.

    `rows[i]` (N,) and `pixels[i]` (N, 2) float32 are the points that frame i saw, as rows of `xyz`, and their pixels.
    """

    def __init__(self) -> None:
        self.rows: list[NDArray[np.int64]] = []
        self.pixels: list[NDArray[np.float32]] = []
        self._row_of: dict[int, int] = {}
        self._xyz = np.zeros((0, 3))
        self._colours = np.zeros((0, 4))  # sums of red, green, blue, and of how many

    def __len__(self) -> int:
        return len(self._row_of)

    def add(self, frame: TrackedFrame) -> None:
        """Keep what the next frame saw. A point is where the last frame says that it is."""
        points = frame.points
        of = self._row_of
        rows = np.array([of.setdefault(i, len(of)) for i in points.ids.tolist()], dtype=np.int64)
        self._grow(len(of))
        self._xyz[rows] = points.xyz
        if not frame.held_out:
            column, row = np.floor(points.pixels).astype(int).T
            rgba = frame.rgba[row, column]
            seen = rgba[:, 3] > 0
            np.add.at(self._colours, rows[seen], np.c_[rgba[seen, :3], np.ones(seen.sum())])
        self.rows.append(rows)
        self.pixels.append(points.pixels.astype(np.float32))

    def move(self, ids: NDArray[np.int64], xyz: NDArray[np.float64]) -> None:
        """Points that a tracker has moved, by its ids (M,), to their places (M, 3); unknown ones are ignored."""
        for i, place in zip(ids.tolist(), xyz, strict=True):
            row = self._row_of.get(i)
            if row is not None:
                self._xyz[row] = place

    def _grow(self, count: int) -> None:
        if count <= len(self._xyz):
            return
        size = max(count, 2 * len(self._xyz))
        for name in ("_xyz", "_colours"):
            old = getattr(self, name)
            new = np.zeros((size, old.shape[1]))
            new[: len(old)] = old
            setattr(self, name, new)

    @property
    def ids(self) -> NDArray[np.int64]:
        """The tracker's ids (P,)."""
        return np.fromiter(self._row_of, np.int64, len(self))

    @property
    def xyz(self) -> NDArray[np.float64]:
        """Places (P, 3) in the world."""
        return self._xyz[: len(self)]

    @property
    def colours(self) -> NDArray[np.uint8]:
        """Mean colours (P, 3) in the frames that are not held out."""
        sums = self._colours[: len(self)]
        mean = np.round(sums[:, :3] / np.maximum(sums[:, 3:], 1)).astype(np.uint8)
        mean[sums[:, 3] == 0] = UNSEEN
        return mean

    def reprojection_error(self, cameras: list, poses: list[NDArray[np.float64]]) -> float | None:
        """Mean distance [px] of the points from their pixels in cameras at T_camera_world (4, 4), frame by frame.

        Over all observations before the camera; None where there is none.
        """
        total, count = 0.0, 0
        for camera, T, rows, pixels in zip(cameras, poses, self.rows, self.pixels, strict=True):
            p = self.xyz[rows] @ T[:3, :3].T + T[:3, 3]
            before = p[:, 2] > 0
            total += float(np.linalg.norm(camera.project(p[before]) - pixels[before], axis=1).sum())
            count += int(before.sum())
        return total / count if count else None
