"""Kind `stella_vslam`: its map in MessagePack, and the trajectory of all frames next to it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, Literal

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fields.frames.tracked_frame import SparsePoints
from modp_ti.files import LARGEST, open_file, reading
from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import poses_of_quaternions
from modp_ti.inputs.capture import checked_numbers, plausible_camera
from modp_ti.inputs.point_cloud import visible_points
from modp_ti.inputs.posed_recording import PosedRecording
from modp_ti.inputs.reader import TimedPosesSettings
from modp_ti.inputs.replay import PosedImage, points_inside
from modp_ti.inputs.sources import Distortion, Intrinsics
from modp_ti.inputs.timed_poses import TimedPoses, read_trajectory_file

TRAJECTORY = "frame_trajectory.txt"
MAX_BUFFER = 1 << 26  # bytes of one value, and the longest array

# A frame between keyframes gets the landmarks observed by this many keyframes on either side.
NEIGHBOURS = 2
# A frame is a keyframe if their times differ by at most this [s]. Both are written with 15 digits.
SAME_TIME = 1e-4


@dataclass(frozen=True)
class _Keyframe:
    """A keyframe of the map: its pose, and the landmarks (N,) that it observes at pixels (N, 2), undistorted."""

    time: float
    camera: str
    T_camera_world: NDArray[np.float64]
    landmarks: NDArray[np.int64]
    pixels: NDArray[np.float64]


@dataclass(frozen=True)
class _Map:
    """A map: its cameras by name, its keyframes by time, and the position (3,) of each landmark by id."""

    cameras: dict[str, Intrinsics]
    keyframes: list[_Keyframe]
    landmarks: dict[int, NDArray[np.float64]]

    def positions(self, ids: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.array([self.landmarks[i] for i in ids.tolist()], dtype=np.float64).reshape(-1, 3)


class StellaVslamSettings(TimedPosesSettings):
    """A map of stella_vslam and its trajectory of all frames."""

    kind: Literal["stella_vslam"] = "stella_vslam"
    path: Path | None = Field(
        default=None, description="the map or its folder; empty: `map.msg` next to the images' folder or in it"
    )

    def add_poses(self, recording: PosedRecording) -> None:
        """Give images the poses of the trajectory, and the landmarks of the map.

        A keyframe gets its observed landmarks at the observed pixels. A frame between keyframes gets the landmarks that
        the two keyframes before it and the two after it observe, at their projections, because the files do not contain
        its observations. Without frame_trajectory.txt next to the map, only keyframes are used.
        """
        file = self.found(recording.source, ("map.msg",), "a map of stella_vslam (map.msg)")
        world, all_frames = read_stella_map(file), file.with_name(TRAJECTORY)
        keyframes = world.keyframes
        times_of_keyframes = np.array([keyframe.time for keyframe in keyframes])
        if all_frames.is_file():
            trajectory = read_trajectory_file(all_frames)
        else:
            trajectory = TimedPoses(file, times_of_keyframes, np.stack([each.T_camera_world for each in keyframes]))
            recording.notes.append(
                f"{all_frames} is missing: it would have brought the poses of the frames between the keyframes"
            )
        rows = self.rows_at_frames(recording, trajectory.path, trajectory.times)
        poses, keyframe_of, around = {}, {}, {}
        for name, row in rows.items():
            time = trajectory.times[row]
            nearest = int(np.abs(times_of_keyframes - time).argmin())
            if abs(times_of_keyframes[nearest] - time) <= SAME_TIME:
                keyframe_of[name] = keyframes[nearest]
                # The map's pose comes from the same optimisation as its landmarks.
                poses[name] = keyframes[nearest].T_camera_world
            else:
                after = int(np.searchsorted(times_of_keyframes, time))
                around[name] = keyframes[max(0, after - NEIGHBOURS) : after + NEIGHBOURS]
                poses[name] = trajectory.T_camera_world[row]
        if recording.source.intrinsics.given:
            recording.pose(poses)
        else:
            recording.pose(poses, _camera_of(world, file), str(file))
        recording.add_points(
            lambda frame: (
                _observed(keyframe_of[frame.name], world, frame)
                if frame.name in keyframe_of
                else _projected(around[frame.name], world, frame)
            )
        )
        if around:
            recording.notes.append(
                f"{len(around)} frames between keyframes: the landmarks of the {NEIGHBOURS} keyframes on either side, "
                "at the pixels that they project to"
            )


def _camera_of(world: _Map, file: Path) -> Intrinsics:
    """Return the camera of all keyframes."""
    cameras = {keyframe.camera for keyframe in world.keyframes}
    if len(cameras) > 1:
        raise InputError(f"{file}: keyframes of {len(cameras)} cameras; one is supported")
    return world.cameras[cameras.pop()]


def _observed(keyframe: _Keyframe, world: _Map, frame: PosedImage) -> SparsePoints:
    camera, raw = frame.undistorter.camera, frame.undistorter.raw
    pixels = keyframe.pixels * np.divide((camera.width, camera.height), (raw.width, raw.height))
    xyz = world.positions(keyframe.landmarks)
    return points_inside(xyz, pixels, keyframe.landmarks, frame.undistorter, keyframe.T_camera_world)


def _projected(keyframes: Sequence[_Keyframe], world: _Map, frame: PosedImage) -> SparsePoints:
    ids = np.unique(np.concatenate([keyframe.landmarks for keyframe in keyframes]))
    points = visible_points(world.positions(ids), frame.undistorter, frame.T_camera_world)
    return SparsePoints(points.xyz, points.pixels, ids[points.ids])


def read_stella_map(path: Path) -> _Map:
    """Read the map from a `.msg` file. Descriptors and the graph between keyframes are skipped.

    Raises:
        InputError: If the file is missing, truncated, damaged, or has no keyframes or landmarks.
    """
    with reading(path, " (tracker.path)"), open_file(path) as file:
        if file.read(16).startswith(b"SQLite format 3"):
            raise InputError(
                f"{path}: an SQLite map; let stella_vslam write MessagePack: MapFormat: msgpack in its "
                "configuration, and --map-db-out map.msg"
            )
        try:
            file.seek(0)
            return _read(path, file)
        except msgpack.OutOfData:
            raise InputError(f"{path}: the file is cut off; copy it again or let stella_vslam write it again") from None


def _read(path: Path, file: BinaryIO) -> _Map:
    unpacker, world = msgpack.Unpacker(file, max_buffer_size=MAX_BUFFER), _Map({}, [], {})
    for section in _keys(unpacker):
        if section == "cameras":
            world.cameras.update(
                {name: _camera(unpacker.unpack(), f"{path}: camera {name}") for name in _keys(unpacker)}
            )
        elif section == "keyframes":
            world.keyframes.extend(_keyframe(unpacker.unpack(), f"{path}: keyframe {key}") for key in _keys(unpacker))
        elif section == "landmarks":
            for key in _keys(unpacker):
                where = f"{path}: landmark {key}: `pos_w`"
                world.landmarks[int(key)] = np.array(checked_numbers(unpacker.unpack()["pos_w"], 3, where))
        else:
            unpacker.skip()
    if not world.keyframes or not world.landmarks:
        raise InputError(f"{path}: the map holds no keyframe or no landmark: stella_vslam did not initialise")
    world.keyframes.sort(key=lambda keyframe: keyframe.time)
    for keyframe in world.keyframes:
        if keyframe.camera not in world.cameras or not world.landmarks.keys() >= {*keyframe.landmarks.tolist()}:
            raise InputError(
                f"{path}: the keyframe of {keyframe.time:g} s has a camera or landmarks that the map lacks"
            )
    if any(one.time == other.time for one, other in pairwise(world.keyframes)):
        raise InputError(f"{path}: two keyframes are of one time; let stella_vslam write the map again")
    return world


def _keys(unpacker: msgpack.Unpacker) -> Iterator[str]:
    """Yield the keys of the next map. The caller must consume each value before it requests the next key."""
    for _ in range(unpacker.read_map_header()):
        yield unpacker.unpack()


def _camera(values: dict[str, Any], where: str) -> Intrinsics:
    model = values["model_type"]
    if model not in ("Perspective", "Fisheye"):
        raise InputError(f"{where}: is of model {model!r:.40}; Perspective and Fisheye can be used")

    def number(key: str) -> float:
        return checked_numbers(values.get(key, 0.0 if key[0] in "kp" else None), 1, f"{where}: `{key}`")[0]

    if model == "Fisheye":
        lens = Distortion(tuple(map(number, ("k1", "k2", "k3", "k4"))), fisheye=True)
    else:
        lens = Distortion(tuple(map(number, ("k1", "k2", "k3"))), tangential=(number("p1"), number("p2")))
    fx, fy, cx, cy, width, height = map(number, ("fx", "fy", "cx", "cy", "cols", "rows"))
    # stella_vslam has pixel centres at whole numbers, as OpenCV does.
    return Intrinsics(plausible_camera(fx, fy, cx + 0.5, cy + 0.5, (width, height), where, lens), lens)


def _keyframe(values: dict[str, Any], where: str) -> _Keyframe:
    (time,) = checked_numbers(values["ts"], 1, f"{where}: `ts`")
    rotation, translation = np.array([values["rot_cw"]], float), np.array([values["trans_cw"]], float)
    T_camera_world = poses_of_quaternions(translation.reshape(1, 3), rotation.reshape(1, 4), lambda _: where)[0]
    ids, keypoints = np.array(values["lm_ids"], dtype=np.int64), values["undist_keypts"]  # -1 for no landmark
    if len(ids) != len(keypoints):
        raise InputError(f"{where}: `lm_ids` and `undist_keypts` must be of one length; the file is damaged")
    seen = np.flatnonzero(ids >= 0)
    pixels = np.array([keypoints[i]["pt"] for i in seen], dtype=np.float64).reshape(len(seen), 2) + 0.5
    if not (np.abs(pixels) <= LARGEST).all():
        raise InputError(f"{where}: its keypoints hold NaN or infinite numbers; the file is damaged")
    # If a landmark has two keypoints, the first one is used.
    landmarks, first = np.unique(ids[seen], return_index=True)
    return _Keyframe(time, str(values["cam"]), T_camera_world, landmarks, pixels[first])
