"""The delivered poses and points, and the corrections of them when bundle adjustment moves the map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import CameraRevision, PoseCorrection
from fields.frames.tracked_frame import SparsePoints
from modp_ti.inputs.klt.landmark_map import Keyframe
from modp_ti.inputs.klt.recognition import turn_and_shift
from modp_ti.inputs.klt.tracking import Tracking, View
from modp_ti.inputs.multiview.reprojection import ray_errors
from modp_ti.inputs.replay import PosedImage, points_inside
from modp_ti.inputs.sources import Undistorter

MAX_ERROR = 2.5  # points with a larger reprojection error [px of the tracked image] are not delivered
# Send a correction once a keyframe has moved by `NOTABLE` px of the tracked image; include every keyframe that has
# moved by `MOVED` px.
NOTABLE = 2.0
MOVED = 0.2


class DeliveredTrajectory:
    """Frames and landmarks as the mapper has them.

    Args:
        tracking: The tracking, whose map changes.
        undistorter: Undistortion of the delivered images.

    Attributes:
        views: The delivered views in order.
    """

    def __init__(self, tracking: Tracking, undistorter: Undistorter) -> None:
        self.views: list[View] = []
        self._tracking = tracking
        self._undistorter = undistorter
        # By number: the keyframes of delivered frames, with their delivered poses.
        self._keyframes: dict[int, NDArray[np.float64]] = {}
        self._keyframes_checked = len(tracking.map.keyframes)
        self._xyz = np.zeros((0, 3))
        self._remembered = 0  # the first frame that still has its landmarks

    def add(self, name: str, view: View) -> PosedImage:
        """Add the next frame, of an image's name. Returns it with the landmarks whose reprojection error is small."""
        landmarks, camera, T = self._tracking.map, self._undistorter.camera, self._tracking.pose(view)
        self.views.append(view)
        if view.keyframe not in self._keyframes:
            self._remember([view.keyframe])
        xyz, rays = landmarks.xyz[view.ids], landmarks.lens.rays(view.pixels)
        good = landmarks.known[view.ids] & ~landmarks.assumed[view.ids]
        good &= (ray_errors(T, xyz, rays) * landmarks.lens.focal) < MAX_ERROR
        pixels = rays[good] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        points = points_inside(xyz[good], pixels, view.ids[good], self._undistorter, T)
        return PosedImage(name, self._undistorter, T, points)

    def record(self, points: SparsePoints) -> None:
        """Record points that were delivered. Only the first position of each is kept until it is corrected."""
        fresh = max(0, len(self._tracking.map.known) - len(self._xyz))
        self._xyz = np.concatenate([self._xyz, np.full((fresh, 3), np.nan)])
        new = np.isnan(self._xyz[points.ids, 0])
        self._xyz[points.ids[new]] = points.xyz[new]

    def forget_points(self) -> None:
        """Forget the landmarks of all frames, once the camera is final. Poses are still corrected."""
        for view in self.views[self._remembered :]:
            view.forget_landmarks()
        self._remembered = len(self.views)

    def corrections(self, last: bool = False) -> Iterator[PoseCorrection]:
        """Yield one correction, with the frames of all moved keyframes, if a keyframe has moved notably.

        Keyframes are compared when the map has a new one, and at the end.

        Args:
            last: There are no more frames: small motions are corrected too.
        """
        landmarks = self._tracking.map
        if not last and len(landmarks.keyframes) == self._keyframes_checked:
            return
        self._keyframes_checked = len(landmarks.keyframes)
        moved = {number: self._shift(number) for number in self._keyframes}
        if max(moved.values()) < (MOVED if last else NOTABLE):
            return
        affected = {number for number, shift in moved.items() if shift >= MOVED}
        index = [i for i, view in enumerate(self.views) if view.keyframe in affected]
        known = self._known()
        away = np.linalg.norm(landmarks.xyz[known] - self._xyz[known], axis=1)
        ids = known[away > MOVED * self._depth(self._keyframe(max(affected))) / landmarks.lens.focal]
        yield self._corrected(index, affected, ids)

    def revise_camera(self, undistorter: Undistorter) -> PoseCorrection:
        """Return the correction of all frames and points, after the map has got another camera.

        Args:
            undistorter: Undistortion of the delivered images with the new camera.
        """
        revision, self._undistorter = undistorter.revising(self._undistorter), undistorter
        for view in self.views:
            self._tracking.relocalise(view)
        return self._corrected(range(len(self.views)), list(self._keyframes), self._known(), revision)

    def _corrected(
        self,
        index: Iterable[int],
        keyframes: Iterable[int],
        ids: NDArray[np.int64],
        camera: CameraRevision | None = None,
    ) -> PoseCorrection:
        """The correction of the frames of `index`, whose keyframes are given, and of landmarks (N,)."""
        self._remember(keyframes)
        xyz = self._xyz[ids] = self._tracking.map.xyz[ids]
        poses = np.stack([self._tracking.pose(self.views[i]) for i in index])
        return PoseCorrection(np.array(index, dtype=np.int64), poses, ids, xyz, camera, camera is None)

    def _known(self) -> NDArray[np.int64]:
        """Ids of the landmarks that were delivered and still have a position."""
        landmarks, count = self._tracking.map, len(self._xyz)
        firm = landmarks.known[:count] & ~landmarks.assumed[:count]
        return np.flatnonzero(~np.isnan(self._xyz[:, 0]) & firm)

    def _keyframe(self, number: int) -> Keyframe:
        return self._tracking.map.keyframes[self._tracking.map.index(number)]

    def _remember(self, numbers: Iterable[int]) -> None:
        """Record that the poses of these keyframes were delivered."""
        self._keyframes |= {number: self._keyframe(number).T_camera_world.copy() for number in numbers}

    def _depth(self, keyframe: Keyframe) -> float:
        """Median depth of the landmarks that a keyframe sees."""
        landmarks, T = self._tracking.map, keyframe.T_camera_world
        ids = keyframe.ids[landmarks.known[keyframe.ids]]
        return float(np.median(landmarks.xyz[ids] @ T[2, :3] + T[2, 3])) if len(ids) else 1.0

    def _shift(self, number: int) -> float:
        """Approximate image motion [px of the tracked image] of a keyframe since its pose was last delivered."""
        keyframe, delivered = self._keyframe(number), self._keyframes[number]
        if np.array_equal(keyframe.T_camera_world, delivered):
            return 0.0
        turn, away = turn_and_shift(keyframe.T_camera_world, delivered)
        return (turn + away / max(self._depth(keyframe), 1e-12)) * self._tracking.map.lens.focal
