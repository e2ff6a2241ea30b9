"""Pose corrections of a tracker: their effect on the frames in between, on keyframes, and on the world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import CameraRevision, PoseCorrection
from fields.frames.tracked_frame import SparsePoints
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import (
    interpolate_se3,
    inverse_se3,
    motion_around,
    moved_points,
    moved_pose,
    orthonormalised,
    scale_of,
)
from fields.map.gaussian_motion import GaussianMotion
from fields.map.gaussians import NO_ANCHOR
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.companions.paging import Paging
from pipelines.densify.densifier import Densifier
from pipelines.render.spherical_harmonics import sh_rotation
from pipelines.settings import CorrectionSettings

NO_MOTION = np.eye(4)
# Minimum number of moved points to estimate a keyframe's change of scale.
MIN_POINTS = 10


@dataclass(frozen=True)
class WorldMotion:
    """The motion of frames and of the world around them by a correction.

    Attributes:
        index: Indices (N,) of the corrected frames whose former pose is known, increasing.
        T_camera_world: Revised tracked poses (N, 4, 4) of these frames.
        S: Similarities S_after_before (N, 4, 4) of the world around them.
    """

    index: NDArray[np.int64]
    T_camera_world: NDArray[np.float64]
    S: NDArray[np.float64]

    def of(self, index: int, T_tracked: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Compute the revised pose of any frame.

        A frame between two corrected ones moves with the world of each, and the two resulting poses are interpolated by
        frame index. A frame outside the corrected range moves with the nearest corrected frame.

        Args:
            index: Index of the frame.
            T_tracked: Former tracked pose (4, 4).

        Returns:
            Revised pose (4, 4), and similarity S_after_before (4, 4) of the world around the frame.
        """
        after = int(np.searchsorted(self.index, index))
        if after < len(self.index) and self.index[after] == index:
            return self.T_camera_world[after].copy(), self.S[after].copy()
        if len(self.index) == 0:
            return T_tracked.copy(), np.eye(4)
        if after in (0, len(self.index)):
            S = self.S[min(after, len(self.index) - 1)]
            return moved_pose(S, T_tracked), S.copy()
        a, b = self.S[after - 1], self.S[after]
        if np.array_equal(a, b):
            return moved_pose(a, T_tracked), a.copy()
        t = (index - self.index[after - 1]) / (self.index[after] - self.index[after - 1])
        T = orthonormalised(interpolate_se3(moved_pose(a, T_tracked), moved_pose(b, T_tracked), t))
        return T, motion_around(T_tracked, T, float(scale_of(a) ** (1.0 - t) * scale_of(b) ** t))


@dataclass(frozen=True)
class CorrectionReport:
    """Result of a correction.

    Attributes:
        around: Similarity S_after_before (4, 4) of the world around each frame whose world moved, by index.
        moved: Whether Gaussians have moved.
    """

    around: dict[int, NDArray[np.float64]]
    moved: bool


class MapCorrector:
    """Applies the corrections of a tracker to an online map.

    Keyframe poses change at once. Gaussians move with the views that placed them as soon as a keyframe's image would
    otherwise be displaced by more than `corrections.min_pixels`; the voxels are then marked again. With a new camera,
    they move at once: in addition, each moves onto the new ray of its pixel in the keyframe that placed it.

    Args:
        keyframes: The keyframes of the map.
        densifier: Owner of the map's anchors and voxels.
        paging: Keeps the part of the map that is on disk, which moves as well.

    Attributes:
        motion: Moves the Gaussians.
        pending: Similarity (4, 4) of the world around a keyframe, by its index, that its Gaussians have yet to follow.
    """

    def __init__(self, keyframes: KeyframeStore, densifier: Densifier, paging: Paging) -> None:
        self.keyframes = keyframes
        self.densifier = densifier
        self.paging = paging
        self.motion = GaussianMotion(densifier.gaussians)
        self.pending: dict[int, NDArray[np.float64]] = {}

    def correct(
        self, correction: PoseCorrection, settings: CorrectionSettings, more: bool = False
    ) -> tuple[dict[int, NDArray[np.float64]], NDArray[np.int64]]:
        """Apply poses and points that the tracker has revised. Call it between two steps.

        Args:
            correction: The revised poses and points.
            settings: When Gaussians follow.
            more: Whether another correction follows at once, with which the Gaussians then move.

        Returns:
            Motion of the world as `revise` returns it, and the keyframes (N,) whose Gaussians moved, as places in the
            store.
        """
        former = self.keyframes[0].camera if len(self.keyframes) else None
        around = revise(self.keyframes, correction)
        for view in self.keyframes:
            if view.index in around:
                self.pending[view.index] = around[view.index] @ self.pending.get(view.index, NO_MOTION)
        if correction.camera is not None and former is not None and settings.enabled:
            self._move_gaussians((correction.camera, former))
            return around, np.arange(len(self.keyframes))
        moved = (motion_in_pixels(view, self.pending.get(view.index, NO_MOTION)) for view in self.keyframes)
        pending = np.fromiter(moved, np.float64, len(self.keyframes))
        if more or not (settings.enabled and (pending > settings.min_pixels).any()):
            return around, np.zeros(0, dtype=np.int64)
        self._move_gaussians()
        return around, np.flatnonzero(pending > 0)

    def _move_gaussians(self, camera: tuple[CameraRevision, PinholeCamera] | None = None) -> None:
        """Move the Gaussians by the pending motion of their anchors, and mark the voxels again.

        Args:
            camera: A new camera and the former one, if the Gaussians move onto the rays of the new one as well.
        """
        growth = 1.0 if camera is None else camera[1].focal / camera[0].camera.focal
        anchors, voxels = self.densifier.anchors, self.densifier.voxels
        degree = self.densifier.gaussians.sh_degree
        no_turn = sh_rotation(degree, np.eye(3))
        turns = {index: sh_rotation(degree, S[:3, :3] / scale_of(S)) for index, S in self.pending.items()}
        if anchors:
            S = np.stack([self.pending.get(anchor.keyframe.index, NO_MOTION) for anchor in anchors])
            turn = np.stack([turns.get(anchor.keyframe.index, no_turn) for anchor in anchors])

            def move(first: int) -> None:
                self.motion.move(S, turn, first)
                if camera is not None:
                    self.motion.place(self._on_new_rays(*camera, first), growth, first)

            move(0)
            self.paging.rewrite(move)
            for anchor, scale in zip(anchors, scale_of(S).tolist(), strict=True):
                anchor.spacing *= scale * growth
        if voxels is not None:
            first = self.pending.get(self.keyframes[0].index, NO_MOTION)
            origin = moved_points(first, voxels.origin[None])[0]
            coarsest = voxels.coarsest * float(scale_of(first)) * growth
            self.densifier.restart_voxels(coarsest, origin, *self.paging.placed())
        self.pending.clear()

    def state(self) -> dict[str, NDArray]:
        """Return the pending motions as arrays, for `restore`."""
        motions = np.array(list(self.pending.values())).reshape(-1, 4, 4)
        return {"index": np.array(list(self.pending), dtype=np.int64), "S": motions}

    def restore(self, state: Mapping[str, NDArray]) -> None:
        """Restore the result of `state`."""
        self.pending = dict(zip(state["index"].tolist(), np.array(state["S"]), strict=True))

    def _on_new_rays(self, revision: CameraRevision, former: PinholeCamera, first: int) -> NDArray[np.float64]:
        """Positions (N, 3) of Gaussians from `first` on, at their depths on the new rays of their anchors' pixels."""
        position = self.densifier.gaussians.to_numpy(first)["position"].astype(np.float64)
        of = self.densifier.gaussians.anchors(first)
        placed = of != NO_ANCHOR
        T = np.stack([anchor.keyframe.T_camera_world for anchor in self.densifier.anchors])[of[placed]]
        here = np.einsum("nij,nj->ni", T[:, :3, :3], position[placed]) + T[:, :3, 3]
        there = revision.points(here, former)
        position[placed] = np.einsum("nji,nj->ni", T[:, :3, :3], there - T[:, :3, 3])
        return position


def revise(store: KeyframeStore, correction: PoseCorrection) -> dict[int, NDArray[np.float64]]:
    """Apply a correction to the tracked poses of all frames, and to the poses, points, depths and camera of keyframes.

    Corrected frames take the pose that the correction names, and all others move with the world around them unless they
    stay. Corrected frames without a tracked pose are ignored. The Gaussians are not moved.

    Returns:
        Similarity S_after_before (4, 4) of the world around each frame whose world moved, by index.
    """
    trajectory = store.trajectory
    # Held-out frames take their corrected poses as well, but must not move the map.
    known = np.array([int(i) in trajectory and int(i) not in trajectory.held_out for i in correction.index])
    index, T_after = correction.index[known], correction.T_camera_world[known]
    order = np.argsort(correction.ids, kind="stable")
    ids, xyz = correction.ids[order], correction.xyz[order]
    scale = _scales(store, index, T_after, ids, xyz)
    S = [motion_around(trajectory[int(i)], T, s) for i, T, s in zip(index, T_after, scale, strict=True)]
    motion = WorldMotion(index, T_after, np.array(S).reshape(-1, 4, 4))
    named = dict(zip(correction.index.tolist(), correction.T_camera_world.copy(), strict=True))
    before = {i: T for i, T in trajectory.items() if i in named or not correction.others_stay}
    after = {i: motion.of(i, T) for i, T in before.items()}
    trajectory.revise({i: T for i, (T, _) in after.items()} | named)
    for keyframe in store:
        if keyframe.index in after:
            keyframe.follow(before[keyframe.index], after[keyframe.index][1])
    if correction.camera is not None:
        store.revise_camera(correction.camera)
    for keyframe in store:
        mine, theirs = _matches(keyframe.points, ids)
        if len(mine):
            moved = keyframe.points.xyz.copy()
            moved[mine] = xyz[theirs]
            if not np.array_equal(moved, keyframe.points.xyz):
                keyframe.revise_points(replace(keyframe.points, xyz=moved))
    store.take_in_depths()
    return {i: S for i, (_, S) in after.items() if not np.array_equal(S, NO_MOTION)}


def motion_in_pixels(view: Keyframe, S: NDArray[np.float64]) -> float:
    """Displacement of a keyframe's image by a motion S (4, 4) that its Gaussians have not followed yet [px].

    This is the mean over a grid of pixels at the keyframe's median depth; infinite if one of them would lie behind or
    too close to the camera.
    """
    if np.array_equal(S, NO_MOTION):
        return 0.0
    camera = view.camera
    across, down = (np.arange(0.1, 1.0, 0.2) * side for side in (camera.width, camera.height))
    grid = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    here = camera.unproject(grid, np.full(len(grid), view.median_depth))
    there = moved_points(view.T_camera_world @ np.linalg.inv(S) @ inverse_se3(view.T_camera_world), here)
    if (there[:, 2] < 1e-3 * view.median_depth).any():
        return float("inf")
    return float(np.linalg.norm(camera.project(there) - grid, axis=1).mean())


def _scales(
    store: KeyframeStore,
    index: NDArray[np.int64],
    T_after: NDArray[np.float64],
    ids: NDArray[np.int64],
    xyz: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Change of scale (N,) at the corrected frames; `ids` (M,) are sorted.

    The change at a keyframe is the median ratio of depths after and before, over its moved points. It is interpolated
    by index for the other frames (on a log scale), and 1 if no keyframe has enough moved points.
    """
    place = {int(i): n for n, i in enumerate(index)}
    at, logs = [], []
    for keyframe in store:
        if keyframe.index not in place:
            continue
        mine, theirs = _matches(keyframe.points, ids)
        before = keyframe.points.depths(keyframe.T_tracked)[mine]
        T = T_after[place[keyframe.index]]
        after = xyz[theirs] @ T[2, :3] + T[2, 3]
        valid = (before > 0) & (after > 0)
        if np.count_nonzero(valid) >= MIN_POINTS:
            at.append(keyframe.index)
            logs.append(np.log(np.median(after[valid] / before[valid])))
    return np.exp(np.interp(index, at, logs)) if at else np.ones(len(index))


def _matches(points: SparsePoints, ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of `points` and of the sorted `ids` that refer to the same points."""
    if len(ids) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    place = np.minimum(np.searchsorted(ids, points.ids), len(ids) - 1)
    mine = np.flatnonzero(ids[place] == points.ids)
    return mine, place[mine]
