"""Tracker `stella_vslam`: its map in MessagePack, and the trajectory of all frames beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.tracked_frame import SparsePoints
from modp_ti.config import SourceSettings, TrackerSettings
from modp_ti.errors import InputError
from modp_ti.sources import ImageSource, Intrinsics, Undistorter, open_source
from modp_ti.trackers.given_poses import checked_reader, found_file, missing_frames_note, selected_frames
from modp_ti.trackers.point_cloud import visible_points
from modp_ti.trackers.replay import PosedImage, ReplayedTracker, points_inside
from modp_ti.trackers.stella_map import StellaKeyframe, StellaMap, read_stella_map
from modp_ti.trackers.trajectory import Trajectory, poses_at_frames, read_trajectory_file

__all__ = ["open_stella_vslam"]

TRAJECTORY = "frame_trajectory.txt"
# A frame between keyframes is shown what this many of them on either side of it observe.
NEIGHBOURS = 2
# A keyframe is the frame whose time differs by less than this [s]; both were written with 15 digits.
SAME_TIME = 1e-4


def open_stella_vslam(source: SourceSettings, tracker: TrackerSettings) -> ReplayedTracker:
    """The images that stella_vslam has poses for, in the source's order, with the landmarks that each sees.

    A keyframe sees what it observed, where it observed it. A frame between keyframes sees the landmarks that two
    keyframes before and two after it observe, where they project to: nothing in stella_vslam's files says more. Without
    frame_trajectory.txt beside the map there are keyframes alone. Raises InputError for a map or trajectory that is
    missing or malformed, and images that do not fit the map's camera or times.
    """
    assert source.path is not None, "the configuration asks for it"
    file = found_file(
        tracker.path, [source.path.parent / "map.msg", source.path / "map.msg"], "a map of stella_vslam (map.msg)"
    )
    world = read_stella_map(file)
    beside = file.with_name(TRAJECTORY)
    trajectory = read_trajectory_file(beside) if beside.is_file() else None
    images = open_source(source)
    selected = selected_frames(images, source)
    keyframe_poses = Trajectory(
        file,
        np.array([keyframe.time for keyframe in world.keyframes]),
        np.stack([keyframe.T_camera_world for keyframe in world.keyframes]),
    )
    poses = poses_at_frames(images, selected, keyframe_poses if trajectory is None else trajectory, tracker)

    intrinsics, said_by = _intrinsics(images, world, source)
    undistorter = intrinsics.undistorter(source.scale)
    names = sorted(poses, key=images.position)
    reader = checked_reader(images, source, names, undistorter, said_by)

    keyframe_of = _keyframes_of(images, names, world, tracker)
    times = keyframe_poses.times + tracker.time_offset
    frames = []
    for name in names:
        keyframe = keyframe_of.get(name)
        if keyframe is not None:
            # The map's own pose: of the same optimisation as its landmarks.
            T = keyframe.T_camera_world
            frames.append(PosedImage(name, undistorter, T, _observed(keyframe, world, undistorter)))
            continue
        after = int(np.searchsorted(times, images.timestamp(name)))
        around = world.keyframes[max(0, after - NEIGHBOURS) : after + NEIGHBOURS]
        points = _projected(around, world, undistorter, poses[name])
        frames.append(PosedImage(name, undistorter, poses[name], points))

    notes = [*images.notes, *missing_frames_note(selected, poses, file if trajectory is None else beside)]
    if trajectory is None:
        notes.append(f"{beside} is missing: it would have brought the poses of the frames between the keyframes")
    between = len(frames) - len(keyframe_of)
    if between:
        notes.append(
            f"{between} frames between keyframes: the landmarks of the {NEIGHBOURS} keyframes on either side, at the "
            "pixels that they project to"
        )
    return ReplayedTracker(reader, frames, source, notes)


def _intrinsics(images: ImageSource, world: StellaMap, source: SourceSettings) -> tuple[Intrinsics, str]:
    """The camera, and who says so: the user before the map before the source."""
    if source.intrinsics is not None and images.intrinsics is not None:
        return images.intrinsics, "source.intrinsics"
    cameras = {keyframe.camera for keyframe in world.keyframes}
    if len(cameras) > 1:
        raise InputError(f"{world.path}: keyframes of {len(cameras)} cameras; one is supported")
    return world.cameras[cameras.pop()], str(world.path)


def _keyframes_of(
    images: ImageSource, names: Sequence[str], world: StellaMap, tracker: TrackerSettings
) -> dict[str, StellaKeyframe]:
    """Which of the images are keyframes."""
    times = np.array([keyframe.time for keyframe in world.keyframes]) + tracker.time_offset
    found = {}
    for name in names:
        time = images.timestamp(name)
        nearest = int(np.abs(times - time).argmin())
        if abs(times[nearest] - time) <= min(SAME_TIME, tracker.max_difference):
            found[name] = world.keyframes[nearest]
    return found


def _observed(keyframe: StellaKeyframe, world: StellaMap, undistorter: Undistorter) -> SparsePoints:
    xyz = _positions(keyframe.landmarks, world)
    camera = undistorter.camera
    pixels = keyframe.pixels * np.divide((camera.width, camera.height), (undistorter.raw.width, undistorter.raw.height))
    return points_inside(xyz, pixels, keyframe.landmarks, undistorter, keyframe.T_camera_world)


def _projected(
    keyframes: Sequence[StellaKeyframe], world: StellaMap, undistorter: Undistorter, T_camera_world: NDArray[np.float64]
) -> SparsePoints:
    ids = np.unique(np.concatenate([keyframe.landmarks for keyframe in keyframes]))
    points = visible_points(_positions(ids, world), undistorter, T_camera_world)
    return SparsePoints(points.xyz, points.pixels, ids[points.ids])


def _positions(ids: NDArray[np.int64], world: StellaMap) -> NDArray[np.float64]:
    return np.array([world.landmarks[i] for i in ids.tolist()], dtype=np.float64).reshape(-1, 3)
