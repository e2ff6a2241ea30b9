"""The delivered poses and points, and the corrections of them when bundle adjustment moves the map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints
from fields.geometry.se3 import inverse_se3
from modp_ti.inputs.klt.landmark_map import Keyframe
from modp_ti.inputs.klt.tracking import Tracking, View
from modp_ti.inputs.multiview.reprojection import ray_errors
from modp_ti.inputs.replay import points_inside
from modp_ti.inputs.sources import Undistorter

MAX_ERROR = 2.5  # points with a larger reprojection error [px of the tracked image] are not delivered
# Send a correction once a keyframe has moved by `NOTABLE` px of the tracked image; include every keyframe that has
# moved by `MOVED` px.
NOTABLE = 2.0
MOVED = 0.2


@dataclass
class DeliveredFrame:
    """A frame with its last delivered pose.

    Attributes:
        name: Name of its image.
        view: Its pose relative to a keyframe, and its landmarks.
        T_camera_world: (4, 4) the delivered pose.
    """

    name: str
    view: View
    T_camera_world: NDArray[np.float64]


class DeliveredTrajectory:
    """Frames and landmarks as the mapper has them.

    Args:
        tracking: The tracking, whose map changes.
        undistorter: Undistortion of the delivered images.

    Attributes:
        frames: The delivered frames in order.
    """

    def __init__(self, tracking: Tracking, undistorter: Undistorter) -> None:
        self.frames: list[DeliveredFrame] = []
        self._tracking = tracking
        self._map = tracking.map
        self._undistorter = undistorter
        # By number of the frame: the keyframes of delivered frames, with their delivered poses.
        self._keyframes: dict[int, tuple[Keyframe, NDArray[np.float64]]] = {}
        self._keyframes_checked = len(tracking.map.keyframes)
        self._xyz = np.zeros((0, 3))
        self._remembered = 0  # the first frame that still has its landmarks

    def add(self, name: str, view: View) -> DeliveredFrame:
        """Add the next frame."""
        frame = DeliveredFrame(name, view, self._tracking.pose(view))
        self.frames.append(frame)
        keyframe = view.keyframe
        self._keyframes.setdefault(keyframe.number, (keyframe, keyframe.T_camera_world.copy()))
        return frame

    def points(self, frame: DeliveredFrame) -> SparsePoints:
        """Landmarks of a frame whose reprojection error is small, in pixels of the delivered image."""
        ids, lens, camera = frame.view.ids, self._map.lens, self._undistorter.camera
        xyz, rays = self._map.xyz[ids], lens.rays(frame.view.pixels)
        good = self._map.known[ids] & (ray_errors(frame.T_camera_world, xyz, rays) * lens.focal < MAX_ERROR)
        pixels = rays[good] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        return points_inside(xyz[good], pixels, ids[good], self._undistorter, frame.T_camera_world)

    def record(self, points: SparsePoints) -> None:
        """Record points that were delivered. Only the first position of each is kept until it is corrected."""
        fresh = max(0, len(self._map.known) - len(self._xyz))
        self._xyz = np.concatenate([self._xyz, np.full((fresh, 3), np.nan)])
        new = np.isnan(self._xyz[points.ids, 0])
        self._xyz[points.ids[new]] = points.xyz[new]

    def forget_points(self) -> None:
        """Forget the landmarks of all frames, once the camera is final. Poses are still corrected."""
        for frame in self.frames[self._remembered :]:
            frame.view = replace(frame.view, ids=frame.view.ids[:0].copy(), pixels=frame.view.pixels[:0].copy())
        self._remembered = len(self.frames)

    def corrections(self, last: bool = False) -> Iterator[PoseCorrection]:
        """Yield one correction, with the frames of all moved keyframes, if a keyframe has moved notably.

        Keyframes are compared when the map has a new one, and at the end.

        Args:
            last: There are no more frames: small motions are corrected too.
        """
        landmarks = self._map
        if not last and len(landmarks.keyframes) == self._keyframes_checked:
            return
        self._keyframes_checked = len(landmarks.keyframes)
        moved = {number: self._shift(*each) for number, each in self._keyframes.items()}
        if max(moved.values()) < (MOVED if last else NOTABLE):
            return
        affected = {number for number, shift in moved.items() if shift >= MOVED}
        index = [i for i, frame in enumerate(self.frames) if frame.view.keyframe.number in affected]
        for i in index:
            self.frames[i].T_camera_world = self._tracking.pose(self.frames[i].view)
        self._remember(affected)
        known = np.flatnonzero(~np.isnan(self._xyz[:, 0]) & landmarks.known[: len(self._xyz)])
        away = np.linalg.norm(landmarks.xyz[known] - self._xyz[known], axis=1)
        ids = known[away > MOVED * self._depth(self._keyframes[max(affected)][0]) / landmarks.lens.focal]
        self._xyz[ids] = landmarks.xyz[ids]
        yield PoseCorrection(
            index=np.array(index, dtype=np.int64),
            T_camera_world=np.stack([self.frames[i].T_camera_world for i in index]),
            ids=ids.astype(np.int64),
            xyz=landmarks.xyz[ids].copy(),
            others_stay=True,
        )

    def revise_camera(self, undistorter: Undistorter) -> PoseCorrection:
        """Return the correction of all frames and points, after the map has got another camera.

        Args:
            undistorter: Undistortion of the delivered images with the new camera.
        """
        revision, self._undistorter = undistorter.revising(self._undistorter), undistorter
        for frame in self.frames:
            self._tracking.relocalise(frame.view)
            frame.T_camera_world = self._tracking.pose(frame.view)
        self._remember(list(self._keyframes))
        ids = np.flatnonzero(~np.isnan(self._xyz[:, 0]) & self._map.known[: len(self._xyz)])
        self._xyz[ids] = self._map.xyz[ids]
        return PoseCorrection(
            index=np.arange(len(self.frames)),
            T_camera_world=np.stack([frame.T_camera_world for frame in self.frames]),
            ids=ids,
            xyz=self._map.xyz[ids].copy(),
            camera=revision,
        )

    def _remember(self, numbers: Iterable[int]) -> None:
        """Record that the poses of these keyframes were delivered."""
        for number in numbers:
            keyframe = self._keyframes[number][0]
            self._keyframes[number] = keyframe, keyframe.T_camera_world.copy()

    def _depth(self, keyframe: Keyframe) -> float:
        """Median depth of the landmarks that a keyframe sees."""
        ids = keyframe.ids[self._map.known[keyframe.ids]]
        T = keyframe.T_camera_world
        return float(np.median(self._map.xyz[ids] @ T[2, :3] + T[2, 3])) if len(ids) else 1.0

    def _shift(self, keyframe: Keyframe, delivered: NDArray[np.float64]) -> float:
        """Approximate image motion [px of the tracked image] of a keyframe since its pose was last delivered."""
        if np.array_equal(keyframe.T_camera_world, delivered):
            return 0.0
        change = keyframe.T_camera_world @ inverse_se3(delivered)
        turn = float(np.arccos(np.clip((np.trace(change[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
        away = float(np.linalg.norm(change[:3, 3])) / max(self._depth(keyframe), 1e-12)
        return (turn + away) * self._map.lens.focal
