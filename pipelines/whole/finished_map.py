"""Continuing with a finished map: its Gaussians and its frames become the state of a new online map."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.map.gaussians import NO_ANCHOR
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.densify.densifier import Anchor
from pipelines.online import OnlineMapper
from pipelines.render.formulas import IDENTITY


@dataclass(frozen=True)
class FinishedMap:
    """What a finished run keeps of its map.

    Attributes:
        gaussians: The Gaussians, as from `GaussianField.to_numpy`.
        frames: All of its frames in order, with their refined poses, or the tracked ones if `poses` has the refined
            ones. They are iterated over once.
        keyframes: Indices of the keyframes.
        exposures: Exposure (3, 4) by frame index, for the frames that have one.
        scene_depth: Depth of keyframes without tracked points [scene units].
        poses: Refined T_camera_world (4, 4) by frame index, where it is not that of the frame.
        masks: `Keyframe.transient` (h, w) by frame index, where there is one.
    """

    gaussians: Mapping[str, NDArray]
    frames: Iterable[TrackedFrame]
    keyframes: Collection[int]
    exposures: Mapping[int, NDArray[np.float64]]
    scene_depth: float
    poses: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)
    masks: Mapping[int, NDArray[np.uint8]] = field(default_factory=dict)


def go_on(mapper: OnlineMapper, finished: FinishedMap) -> None:
    """Put a finished map into a new online map, so that more frames can follow.

    The finished map keeps no optimiser state and no voxels. The moments of Adam start at zero. The voxels are marked
    again from the Gaussians, each at the voxel size of the first keyframe that has it in its image, which becomes its
    anchor. The keyframes are views again, with the errors of their images in the map.

    Args:
        mapper: The new map, without frames.
        finished: The finished map.

    Raises:
        ValueError: If the Gaussians do not fit the settings, or none of the keyframes is among the frames.
    """
    mapper.gaussians.load(dict(finished.gaussians))  # first, for the memory budget of the keyframes
    take_in_frames(mapper, finished)
    take_in_gaussians(mapper, finished.gaussians)


def take_in_frames(mapper: OnlineMapper, finished: FinishedMap) -> None:
    """Take the frames of a finished map into a new one: their poses, and the keyframes as views.

    Raises:
        ValueError: If none of the keyframes is among the frames.
    """
    unexposed = np.array(IDENTITY) if mapper.settings.exposure.enabled is True else None
    for frame in finished.frames:
        mapper.trajectory.add(frame)
        if frame.held_out:
            continue
        mapper.frame_count += 1
        view = _view_of(mapper, frame, frame.index in finished.keyframes)
        if view is not None:
            if frame.index in finished.poses:
                view.T_camera_world = finished.poses[frame.index]
            view.exposure = finished.exposures.get(frame.index, unexposed)
            if frame.index in finished.masks:
                mapper.keyframes.mask(view, finished.masks[frame.index])
            if len(view.points) == 0:
                view.median_depth = finished.scene_depth
    if len(mapper.keyframes) == 0:
        raise ValueError("none of the map's keyframes is among its frames")
    mapper.keyframes.take_in_depths()


def take_in_gaussians(mapper: OnlineMapper, gaussians: Mapping[str, NDArray]) -> None:
    """Take the Gaussians of a finished map into a new one that has its frames, with anchors, voxels and errors.

    Raises:
        ValueError: If the Gaussians do not fit the settings.
    """
    mapper.gaussians.load(dict(gaussians))
    _restore_anchors(mapper, gaussians["position"].astype(np.float64))
    for view in mapper.keyframes:
        mapper.paging.before_views([view])
        values = mapper.optimiser.compare(view, mapper.keyframes.scene_depth)
        if np.isfinite(values.l1):
            view.note_error(values.l1)


def _view_of(mapper: OnlineMapper, frame: TrackedFrame, is_keyframe: bool) -> Keyframe | None:
    """Add a frame as the view that it was, or None if it was none or the memory budget has no room for it."""
    if is_keyframe:
        return mapper.keyframes.append(frame) if mapper.budget.takes_keyframe(frame) else None
    if len(mapper.keyframes) == 0 or not mapper.selector.is_between(frame, mapper.keyframes):
        return None
    return mapper.keyframes.append(frame, is_between=True) if mapper.budget.takes_between(frame) else None


def _restore_anchors(mapper: OnlineMapper, position: NDArray[np.float64]) -> None:
    """Anchor the Gaussians, and mark the voxels of the map."""
    settings, first = mapper.settings.voxels, mapper.keyframes[0]
    mapper.densifier.anchors = [Anchor(view, settings.target * view.view_scale) for view in mapper.keyframes]
    mapper.gaussians.load(mapper.gaussians.to_numpy() | {"anchor": placed_by(mapper.keyframes, position, mapper.near)})
    mapper.densifier.restart_voxels(settings.coarsest * first.view_scale, first.centre, *mapper.paging.placed())


def placed_by(store: KeyframeStore, position: NDArray[np.float64], near: float) -> NDArray[np.int32]:
    """Return the place (N,) in the store of the first keyframe whose image shows each position; NO_ANCHOR if none does.

    Occlusion does not count.

    Args:
        store: The keyframes.
        position: Positions (N, 3) in the world frame.
        near: Depth below which nothing is drawn [scene units].
    """
    found = np.full(len(position), NO_ANCHOR, dtype=np.int32)
    left = np.arange(len(position))
    for place, view in enumerate(store):
        local = position[left] @ view.T_camera_world[:3, :3].T + view.T_camera_world[:3, 3]
        ahead = np.flatnonzero(local[:, 2] > near)
        seen = ahead[view.camera.contains(view.camera.project(local[ahead]))]
        found[left[seen]] = place
        left = np.delete(left, seen)
    return found
