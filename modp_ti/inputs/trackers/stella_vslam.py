"""Tracker `stella_vslam`: its map in MessagePack, and the trajectory of all frames next to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints
from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_settings import StellaVslamSettings
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.replay import PosedImage, ReplayedTracker, points_inside
from modp_ti.inputs.sources import ImageSource, Intrinsics
from modp_ti.inputs.trackers.given_poses import found_file, posed_images
from modp_ti.inputs.trackers.point_cloud import visible_points
from modp_ti.inputs.trackers.stella_map import StellaKeyframe, StellaMap, read_stella_map
from modp_ti.inputs.trackers.trajectory import TimedPoses, read_trajectory_file, rows_at_frames

__all__ = ["open_stella_vslam"]

TRAJECTORY = "frame_trajectory.txt"
# A frame between keyframes gets the landmarks observed by this many keyframes on either side.
NEIGHBOURS = 2
# A frame is a keyframe if their times differ by at most this [s]. Both are written with 15 digits.
SAME_TIME = 1e-4


def open_stella_vslam(source: SourceSettings, tracker: StellaVslamSettings) -> ReplayedTracker:
    """Open the images that stella_vslam has poses for, in the source's order, with the landmarks of each.

    A keyframe gets its observed landmarks at the observed pixels. A frame between keyframes gets the landmarks that the
    two keyframes before it and the two after it observe, at their projections, because the files do not contain its
    observations. Without frame_trajectory.txt next to the map, only keyframes are used. `tracker.path` is the map or
    its folder.

    Raises:
        InputError: If the map is missing, the map or the trajectory is malformed, or images do not match the camera or
            the times.
    """
    place = source.require_path()
    file = found_file(tracker.path, [place.parent / "map.msg", place / "map.msg"], "a map of stella_vslam (map.msg)")
    world = read_stella_map(file)
    beside = file.with_name(TRAJECTORY)
    images = open_source(source)
    keyframe_times = np.array([keyframe.time for keyframe in world.keyframes])
    keyframes_alone = not beside.is_file()
    if keyframes_alone:
        trajectory = TimedPoses(file, keyframe_times, np.stack([each.T_camera_world for each in world.keyframes]))
    else:
        trajectory = read_trajectory_file(beside)
    rows, notes = rows_at_frames(images, source, trajectory.path, trajectory.times, tracker)

    poses = {name: trajectory.T_camera_world[row] for name, row in rows.items()}
    reader, posed = posed_images(images, source, poses, *_intrinsics(images, world, source))
    frames, between = [], 0
    for frame in posed:
        time = trajectory.times[rows[frame.name]]
        nearest = int(np.abs(keyframe_times - time).argmin())
        if abs(keyframe_times[nearest] - time) <= SAME_TIME:
            keyframe = world.keyframes[nearest]
            # The map's pose comes from the same optimisation as its landmarks.
            frame = replace(frame, T_camera_world=keyframe.T_camera_world)
            points = _observed(keyframe, world, frame)
        else:
            after = int(np.searchsorted(keyframe_times, time))
            points = _projected(world.keyframes[max(0, after - NEIGHBOURS) : after + NEIGHBOURS], world, frame)
            between += 1
        frames.append(frame.with_points(points))

    if keyframes_alone:
        notes.append(f"{beside} is missing: it would have brought the poses of the frames between the keyframes")
    if between:
        notes.append(
            f"{between} frames between keyframes: the landmarks of the {NEIGHBOURS} keyframes on either side, at the "
            "pixels that they project to"
        )
    return ReplayedTracker(reader, frames, notes)


def _intrinsics(images: ImageSource, world: StellaMap, source: SourceSettings) -> tuple[Intrinsics, str]:
    """Return the camera and its origin: `source.intrinsics` if the user set it, otherwise the map."""
    if source.intrinsics.given and images.intrinsics is not None:
        return images.intrinsics, "source.intrinsics"
    cameras = {keyframe.camera for keyframe in world.keyframes}
    if len(cameras) > 1:
        raise InputError(f"{world.path}: keyframes of {len(cameras)} cameras; one is supported")
    return world.cameras[cameras.pop()], str(world.path)


def _observed(keyframe: StellaKeyframe, world: StellaMap, frame: PosedImage) -> SparsePoints:
    xyz = _positions(keyframe.landmarks, world)
    camera, raw = frame.undistorter.camera, frame.undistorter.raw
    pixels = keyframe.pixels * np.divide((camera.width, camera.height), (raw.width, raw.height))
    return points_inside(xyz, pixels, keyframe.landmarks, frame.undistorter, keyframe.T_camera_world)


def _projected(keyframes: Sequence[StellaKeyframe], world: StellaMap, frame: PosedImage) -> SparsePoints:
    ids = np.unique(np.concatenate([keyframe.landmarks for keyframe in keyframes]))
    points = visible_points(_positions(ids, world), frame.undistorter, frame.T_camera_world)
    return SparsePoints(points.xyz, points.pixels, ids[points.ids])


def _positions(ids: NDArray[np.int64], world: StellaMap) -> NDArray[np.float64]:
    return np.array([world.landmarks[i] for i in ids.tolist()], dtype=np.float64).reshape(-1, 3)
