"""The log that a run keeps of every frame that its tracker delivered and of its points, with all corrections."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import NO_ORIGIN
from fields.frames.pose_correction import CameraRevision, PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.trajectory import Trajectory
from modp_ti.inputs.multiview.points_and_poses import placed_anew
from modp_ti.inputs.multiview.reprojection import Observations
from modp_ti.inputs.protocol import Tracker
from pipelines.safeguards import OBSERVATION

# Colour of a point seen only by held-out frames. Held-out pixels must not leak into data that others train on.
UNSEEN = (128, 128, 128)
# Memory of a point [bytes].
POINT = 64
# Rows and pixels of a frame without observations.
NOTHING = np.zeros(0, np.int32), np.zeros((0, 2), np.float32)
# Number of the latest ids that are kept in a dictionary, at least, and their largest share of all.
RECENT = 4096
SHARE = 1 / 8


class RowsOfIds:
    """Numbers ids in the order in which they come: the first is row 0.

    An id takes 16 bytes, and not the 65 of a dictionary, which holds the latest ones only.

    Args:
        ids: The ids so far, each once.
    """

    def __init__(self, ids: NDArray[np.int64] | Sequence[int] = ()) -> None:
        self._ids = np.array(ids, dtype=np.int64)
        self._order = np.argsort(self._ids)
        self._recent: dict[int, int] = {}  # rows of the ids after these

    def __len__(self) -> int:
        return len(self._ids) + len(self._recent)

    @property
    def ids(self) -> NDArray[np.int64]:
        """The ids (N,) in the order of their rows."""
        return np.concatenate([self._ids, np.fromiter(self._recent, np.int64, len(self._recent))])

    def find(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the rows (N,) of ids; -1 for those that have none."""
        rows = np.full(len(ids), -1, dtype=np.int64)
        if len(self._ids):
            place = np.searchsorted(self._ids, ids, sorter=self._order)
            found = self._order[np.minimum(place, len(self._ids) - 1)]
            rows = np.where(self._ids[found] == ids, found, rows)
        others = np.flatnonzero(rows < 0)
        rows[others] = [self._recent.get(i, -1) for i in ids[others].tolist()]
        return rows

    def take(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the rows (N,) of ids, after those that had none have got the next ones."""
        rows = self.find(ids)
        others = np.flatnonzero(rows < 0)
        rows[others] = [self._recent.setdefault(i, len(self)) for i in ids[others].tolist()]
        if len(self._recent) > max(RECENT, SHARE * len(self)):
            self._ids, self._recent = self.ids, {}
            self._order = np.argsort(self._ids)
        return rows


class TrackedPoints:
    """Points by tracker id, with the observations of each frame.

    An observation takes 12 bytes, a point 64.

    Attributes:
        rows: Per frame, rows (N,) int32 of `xyz` of the points that the frame observed. Empty if the frame was added
            with `leave_out`.
        pixels: Per frame, the pixels (N, 2) float32 of these points.
    """

    def __init__(self) -> None:
        self.rows: list[NDArray[np.int32]] = []
        self.pixels: list[NDArray[np.float32]] = []
        self._row_of = RowsOfIds()
        self._xyz = np.zeros((0, 3))
        self._colours = np.zeros((0, 4), dtype=np.uint32)  # sums of red, green and blue, and the number of samples
        self._last = np.zeros((0, 1), dtype=np.int32)  # the last frame that observed the point
        self._observations = 0

    def __len__(self) -> int:
        return len(self._row_of)

    @property
    def nbytes(self) -> int:
        """Memory of points and observations [bytes]."""
        return self._observations * OBSERVATION + len(self) * POINT

    def add(self, frame: TrackedFrame) -> None:
        """Record the observations of the next frame. A point takes the position given by the latest frame."""
        points = frame.points
        rows = self._row_of.take(points.ids).astype(np.int32)
        self._grow(len(self))
        self._xyz[rows] = points.xyz
        self._last[rows, 0] = len(self.rows)
        if not frame.held_out:
            column, row = np.floor(points.pixels).astype(int).T
            rgba = frame.rgba[row, column]
            seen = rgba[:, 3] > 0
            np.add.at(self._colours, rows[seen], np.c_[rgba[seen, :3], np.ones(seen.sum(), dtype=np.uint32)])
        self.rows.append(rows)
        self.pixels.append(points.pixels.astype(np.float32))
        self._observations += len(rows)

    def leave_out(self) -> None:
        """Record the next frame without its observations."""
        self.rows.append(NOTHING[0])
        self.pixels.append(NOTHING[1])

    def correct(
        self, ids: NDArray[np.int64], xyz: NDArray[np.float64], motions: Mapping[int, NDArray[np.float64]]
    ) -> None:
        """Apply a correction of the tracker's map.

        Ids that no frame observed are ignored. Points that are not in `ids` move with the last frame that observed
        them.

        Args:
            ids: Ids (N,) of the corrected points.
            xyz: Their new world positions (N, 3).
            motions: Similarity S_after_before (4, 4) of the world around each frame whose world moved, by its place
                among the frames.
        """
        last, places = self._last[: len(self), 0], self.xyz
        frames = np.array(sorted(motions), dtype=np.int64)
        moving = np.flatnonzero(np.isin(last, frames))
        if len(moving):
            S = np.stack([motions[frame] for frame in frames.tolist()])[np.searchsorted(frames, last[moving])]
            places[moving] = np.einsum("nij,nj->ni", S[:, :3, :3], places[moving]) + S[:, :3, 3]
        rows = self._row_of.find(ids)
        places[rows[rows >= 0]] = xyz[rows >= 0]

    def revise_camera(self, revision: CameraRevision) -> None:
        """Move all observations to the images of a new camera. Those that leave the image are dropped."""
        for i, (rows, pixels) in enumerate(zip(self.rows, self.pixels, strict=True)):
            moved = revision.pixels(pixels)
            kept = revision.camera.contains(moved)
            self.rows[i], self.pixels[i] = rows[kept], moved[kept].astype(np.float32)
            self._observations -= int(np.count_nonzero(~kept))

    def state(self) -> dict[str, NDArray]:
        """Return the complete state as arrays, for `restore`."""
        return {
            "counts": np.array([len(rows) for rows in self.rows], dtype=np.int64),
            "rows": np.concatenate([*self.rows, NOTHING[0]]),
            "pixels": np.concatenate([*self.pixels, NOTHING[1]]),
            "ids": self.ids,
            "xyz": self.xyz,
            "colours": self._colours[: len(self)],
            "last": self._last[: len(self)],
        }

    def restore(self, state: Mapping[str, NDArray]) -> None:
        """Restore a state returned by `state`."""
        ends = np.cumsum(state["counts"])  # the last parts are empty
        self.rows, self.pixels = (np.split(state[name], ends)[:-1] for name in ("rows", "pixels"))
        self._observations = len(state["rows"])
        self._row_of = RowsOfIds(state["ids"])
        self._xyz, self._colours, self._last = state["xyz"], state["colours"], state["last"]

    def _grow(self, count: int) -> None:
        if count <= len(self._xyz):
            return
        size = max(count, 2 * len(self._xyz))
        for name in ("_xyz", "_colours", "_last"):
            old = getattr(self, name)
            new = np.zeros((size, old.shape[1]), dtype=old.dtype)
            new[: len(old)] = old
            setattr(self, name, new)

    @property
    def ids(self) -> NDArray[np.int64]:
        """Tracker ids (P,) of the points."""
        return self._row_of.ids

    @property
    def xyz(self) -> NDArray[np.float64]:
        """World positions (P, 3)."""
        return self._xyz[: len(self)]

    @property
    def colours(self) -> NDArray[np.uint8]:
        """Mean colours (P, 3) over valid pixels of the frames that are not held out; `UNSEEN` where there are none."""
        sums = self._colours[: len(self)]
        mean = np.round(sums[:, :3] / np.maximum(sums[:, 3:], 1)).astype(np.uint8)
        mean[sums[:, 3] == 0] = UNSEEN
        return mean

    def reprojection_error(
        self, cameras: list, poses: list[NDArray[np.float64]], places: NDArray[np.float64] | None = None
    ) -> float | None:
        """Compute the mean reprojection error [px] over all observations in front of the camera.

        Args:
            cameras: Camera of each frame.
            poses: T_camera_world (4, 4) of each frame.
            places: World positions (P, 3) to use instead of `xyz`.

        Returns:
            The mean error, or None if there are no observations in front of the camera.
        """
        xyz = self.xyz if places is None else places
        total, count = 0.0, 0
        for camera, T, rows, pixels in zip(cameras, poses, self.rows, self.pixels, strict=True):
            p = xyz[rows] @ T[:3, :3].T + T[:3, 3]
            before = p[:, 2] > 0
            total += float(np.linalg.norm(camera.project(p[before]) - pixels[before], axis=1).sum())
            count += int(before.sum())
        return total / count if count else None

    def placed_anew(
        self, cameras: list, poses: list[NDArray[np.float64]], held_out: Sequence[bool]
    ) -> NDArray[np.float64]:
        """Triangulate the points again for given poses, using only frames that are not held out.

        A point keeps its position if fewer than two of these frames observe it, or if the new position does not reduce
        its robust reprojection error.

        Args:
            cameras: Camera of each frame.
            poses: T_camera_world (4, 4) of each frame.
            held_out: Whether each frame is held out.

        Returns:
            World positions (P, 3).
        """
        if len(self) == 0:
            return self.xyz
        rays = [
            (pixels.astype(np.float64) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
            for camera, pixels in zip(cameras, self.pixels, strict=True)
        ]
        counts = [len(rows) for rows in self.rows]
        seen = Observations(
            np.repeat(np.arange(len(counts)), counts),
            np.concatenate(self.rows).astype(np.int64),
            np.concatenate(rays),
            np.repeat([1.0 / camera.fx for camera in cameras], counts),
        )
        return placed_anew(np.stack(poses), seen, self.xyz, ~np.array(held_out))


@dataclass
class DeliveredFrames:
    """Metadata and observed points of all delivered frames, in order. Images are not kept.

    Attributes:
        index: Index of each frame, as in `TrackedFrame.index`.
        name: Image name of each frame.
        timestamp: Time of each frame [s].
        camera: Camera of each frame.
        held_out: Whether each frame is only for evaluation.
        trajectory: Tracked pose of each frame, shared with the map.
        points: Points and the frames that observed them.
        origin: Where the origin of the poses and points here lies in the world of the tracker (3,), not zero where that
            is far away; None before the first frame.
        corrections: Number of pose corrections received, and of those that moved the map.
    """

    index: list[int] = field(default_factory=list)
    name: list[str] = field(default_factory=list)
    timestamp: list[float] = field(default_factory=list)
    camera: list[PinholeCamera] = field(default_factory=list)
    held_out: list[bool] = field(default_factory=list)
    trajectory: Trajectory = field(default_factory=Trajectory)
    points: TrackedPoints = field(default_factory=TrackedPoints)
    origin: NDArray[np.float64] | None = None
    corrections: dict[str, int] = field(default_factory=lambda: {"received": 0, "moved": 0})

    def __len__(self) -> int:
        return len(self.index)

    @property
    def from_origin(self) -> NDArray[np.float64]:
        """What is added to places here for those in the world of the tracker (3,)."""
        return NO_ORIGIN if self.origin is None else self.origin

    @property
    def T_tracked(self) -> list[NDArray[np.float64]]:  # noqa: N802  # a transform is named by its ends
        """Tracked pose T_camera_world (4, 4) of each frame, with all corrections so far."""
        return [self.trajectory[index] for index in self.index]

    def add(self, frame: TrackedFrame, with_points: bool = True) -> None:
        """Record the next frame without its image.

        Args:
            frame: The next frame.
            with_points: Whether to record its point observations too.
        """
        self.index.append(frame.index)
        self.name.append(frame.name)
        self.timestamp.append(frame.timestamp)
        self.camera.append(frame.camera)
        self.held_out.append(frame.held_out)
        self.trajectory.add(frame)
        if with_points:
            self.points.add(frame)
        else:
            self.points.leave_out()

    def correct(self, correction: PoseCorrection, around: Mapping[int, NDArray[np.float64]], moved: bool) -> None:
        """Apply a correction to the points and cameras. The map has applied it to the trajectory.

        Points named in the correction take the corrected positions. All others move with the world around their frames.

        Args:
            correction: The correction from the tracker.
            around: Similarity S_after_before (4, 4) of the world around each frame whose world moved, by index.
            moved: Whether the correction moved the map.
        """
        motions = {line: around[index] for line, index in enumerate(self.index) if index in around}
        self.points.correct(correction.ids, correction.xyz, motions)
        if correction.camera is not None:
            self.camera = [correction.camera.camera] * len(self)
            self.points.revise_camera(correction.camera)
        self.corrections["received"] += 1
        self.corrections["moved"] += moved

    def again(self, tracker: Tracker) -> Iterator[TrackedFrame]:
        """Read the images of the frames again. Frames have their latest tracked poses and points.

        Args:
            tracker: The tracker that delivered the frames. Those whose images it can no longer read are left out.
        """
        places, ids, xyz = {name: place for place, name in enumerate(self.name)}, self.points.ids, self.points.xyz
        for name, picture in tracker.pictures(self.name):
            place = places[name]
            rows, pixels = self.points.rows[place], self.points.pixels[place].astype(np.float64)
            points, index = SparsePoints(xyz[rows], pixels, ids[rows]), self.index[place]
            pose, held_out = self.trajectory[index], self.held_out[place]
            yield TrackedFrame(
                index,
                self.timestamp[place],
                name,
                T_camera_world=pose,
                points=points,
                held_out=held_out,
                **vars(picture),
            )


def settled(tracker: Tracker) -> Iterator[TrackedFrame]:
    """Iterate over the frames of a tracker with the poses and points that it has at its end.

    The images of a tracker that corrects poses are read twice.
    """
    if not tracker.corrects:
        for event in tracker:
            assert isinstance(event, TrackedFrame), "it corrects nothing"
            yield event
        return
    from fields.map.keyframes import KeyframeStore  # here, so that other trackers are checked without the engine
    from pipelines.corrections import revise

    log, views = DeliveredFrames(), 1
    for event in tracker:
        if isinstance(event, TrackedFrame):
            log.add(event)
            views = event.views
        else:
            log.correct(event, revise(KeyframeStore(trajectory=log.trajectory), event), moved=False)
    for frame in log.again(tracker):
        yield replace(frame, views=views)
