"""Kind `stella_vslam`: its map in MessagePack, and the trajectory of all frames next to it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fields.frames.tracked_frame import SparsePoints
from fields.geometry.camera import PinholeCamera
from modp_ti.files import LARGEST, open_file, reading
from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import poses_of_quaternions
from modp_ti.inputs.given_poses import found_file, posed_images
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.point_cloud import visible_points
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.reader import TimedPosesSettings
from modp_ti.inputs.replay import PosedImage, ReplayedTracker, points_inside
from modp_ti.inputs.sources import Distortion, ImageSource, Intrinsics
from modp_ti.inputs.sources.intrinsics import require_plausible
from modp_ti.inputs.timed_poses import TimedPoses, read_trajectory_file, rows_at_frames

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig, SourceSettings

TRAJECTORY = "frame_trajectory.txt"
# Bounds on lengths stated in the file. The reader allocates an array, including nested ones, when it reads the length,
# before it has seen the content.
MAX_ARRAY = 50_000  # the longest arrays are the keypoints of a keyframe
MAX_TEXT = 4096
MAX_ITEMS = 20_000_000  # keyframes or landmarks
MAX_BUFFER = 1 << 26  # bytes of one value
READ_SIZE = 1 << 20

# A frame between keyframes gets the landmarks observed by this many keyframes on either side.
NEIGHBOURS = 2
# A frame is a keyframe if their times differ by at most this [s]. Both are written with 15 digits.
SAME_TIME = 1e-4


@dataclass(frozen=True)
class _Keyframe:
    """A keyframe of the map.

    Attributes:
        number: Id of the keyframe.
        time: Time [s].
        camera: Name of the camera.
        T_camera_world: Pose (4, 4), world to camera.
        landmarks: Ids (N,) int64 of the observed landmarks.
        pixels: Their pixels (N, 2) in the undistorted image, with pixel centres at +0.5.
    """

    number: int
    time: float
    camera: str
    T_camera_world: NDArray[np.float64]
    landmarks: NDArray[np.int64]
    pixels: NDArray[np.float64]


@dataclass(frozen=True)
class _Map:
    """Contents of a map file.

    Attributes:
        path: The file.
        cameras: Intrinsics by camera name.
        keyframes: Keyframes, ordered by time.
        landmarks: World position (3,) of each landmark by id.
    """

    path: Path
    cameras: dict[str, Intrinsics]
    keyframes: list[_Keyframe]
    landmarks: dict[int, NDArray[np.float64]]


class StellaVslamSettings(TimedPosesSettings):
    """A map of stella_vslam."""

    kind: Literal["stella_vslam"] = Field(
        default="stella_vslam", description="a map of stella_vslam and its trajectory of all frames"
    )
    path: Path | None = Field(
        default=None, description="the map or its folder; empty: `map.msg` next to the images' folder or in it"
    )

    def open(self, scene: SceneConfig, progress: Progress | None = None) -> ReplayedTracker:
        """Open the images that stella_vslam has poses for, in the source's order, with the landmarks of each.

        A keyframe gets its observed landmarks at the observed pixels. A frame between keyframes gets the landmarks that
        the two keyframes before it and the two after it observe, at their projections, because the files do not contain
        its observations. Without frame_trajectory.txt next to the map, only keyframes are used.
        """
        source = scene.source
        place = source.require_path()
        file = found_file(self.path, [place.parent / "map.msg", place / "map.msg"], "a map of stella_vslam (map.msg)")
        world = read_stella_map(file)
        beside = file.with_name(TRAJECTORY)
        images = open_source(source)
        keyframe_times = np.array([keyframe.time for keyframe in world.keyframes])
        keyframes_alone = not beside.is_file()
        if keyframes_alone:
            trajectory = TimedPoses(file, keyframe_times, np.stack([each.T_camera_world for each in world.keyframes]))
        else:
            trajectory = read_trajectory_file(beside)
        rows, notes = rows_at_frames(images, source, trajectory.path, trajectory.times, self)

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
                f"{between} frames between keyframes: the landmarks of the {NEIGHBOURS} keyframes on either side, at "
                "the pixels that they project to"
            )
        return ReplayedTracker(reader, frames, notes)


def _intrinsics(images: ImageSource, world: _Map, source: SourceSettings) -> tuple[Intrinsics, str]:
    """Return the camera and its origin: `source.intrinsics` if the user set it, otherwise the map."""
    if source.intrinsics.given and images.intrinsics is not None:
        return images.intrinsics, "source.intrinsics"
    cameras = {keyframe.camera for keyframe in world.keyframes}
    if len(cameras) > 1:
        raise InputError(f"{world.path}: keyframes of {len(cameras)} cameras; one is supported")
    return world.cameras[cameras.pop()], str(world.path)


def _observed(keyframe: _Keyframe, world: _Map, frame: PosedImage) -> SparsePoints:
    xyz = _positions(keyframe.landmarks, world)
    camera, raw = frame.undistorter.camera, frame.undistorter.raw
    pixels = keyframe.pixels * np.divide((camera.width, camera.height), (raw.width, raw.height))
    return points_inside(xyz, pixels, keyframe.landmarks, frame.undistorter, keyframe.T_camera_world)


def _projected(keyframes: Sequence[_Keyframe], world: _Map, frame: PosedImage) -> SparsePoints:
    ids = np.unique(np.concatenate([keyframe.landmarks for keyframe in keyframes]))
    points = visible_points(_positions(ids, world), frame.undistorter, frame.T_camera_world)
    return SparsePoints(points.xyz, points.pixels, ids[points.ids])


def _positions(ids: NDArray[np.int64], world: _Map) -> NDArray[np.float64]:
    return np.array([world.landmarks[i] for i in ids.tolist()], dtype=np.float64).reshape(-1, 3)


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
            _unpacker(file).skip()  # without allocating anything, checks that every stated length has its content
            file.seek(0)
            return _read(path, file)
        except msgpack.OutOfData:
            raise InputError(f"{path}: the file is cut off; copy it again or let stella_vslam write it again") from None
        except (ValueError, msgpack.UnpackException) as error:
            reason = " ".join(str(error).split())[:120] or type(error).__name__
            raise InputError(
                f"{path}: is damaged, no map in MessagePack, or of another version of stella_vslam ({reason})"
            ) from None


def _unpacker(file: BinaryIO) -> msgpack.Unpacker:
    return msgpack.Unpacker(
        file,
        read_size=READ_SIZE,
        max_buffer_size=MAX_BUFFER,
        max_array_len=MAX_ARRAY,
        max_map_len=MAX_ITEMS,
        max_str_len=MAX_TEXT,
        max_bin_len=0,
        max_ext_len=0,
        raw=False,
    )


def _read(path: Path, file: BinaryIO) -> _Map:
    unpacker = _unpacker(file)
    cameras: dict[str, Intrinsics] = {}
    keyframes: list[_Keyframe] = []
    landmarks: dict[int, NDArray[np.float64]] = {}
    missing = {"cameras": 0, "keyframes": 0, "landmarks": 0}
    for section in _keys(unpacker, "the map"):
        missing.pop(section, None)
        if section == "cameras":
            cameras = {name: _camera(name, unpacker.unpack()) for name in _keys(unpacker, "cameras")}
        elif section == "keyframes":
            keyframes = [_keyframe(unpacker, number) for number in _keys(unpacker, "keyframes")]
        elif section == "landmarks":
            landmarks = {_number(key, "landmark"): _landmark(unpacker, key) for key in _keys(unpacker, "landmarks")}
        else:
            unpacker.skip()
    if missing:
        raise ValueError(f"the map holds no `{next(iter(missing))}`")
    if not keyframes:
        raise InputError(f"{path}: the map holds no keyframe: stella_vslam did not initialise")
    if not landmarks:
        raise InputError(f"{path}: the map holds no landmark: nothing can be mapped from it")
    keyframes.sort(key=lambda keyframe: keyframe.time)
    for keyframe in keyframes:
        lost = next((i for i in keyframe.landmarks.tolist() if i not in landmarks), None)
        if lost is not None:
            raise ValueError(f"keyframe {keyframe.number} observes landmark {lost}, which the map lacks")
        if keyframe.camera not in cameras:
            raise ValueError(f"keyframe {keyframe.number} is of camera {keyframe.camera!r}, which the map lacks")
    for one, other in pairwise(keyframes):
        if one.time == other.time:
            raise ValueError(f"keyframes {one.number} and {other.number} are of one time ({one.time:.6f} s)")
    return _Map(path, cameras, keyframes, landmarks)


def _keys(unpacker: msgpack.Unpacker, what: str) -> Iterator[str]:
    """Yield the keys of the next map. The caller must consume each value before it requests the next key."""
    for _ in range(unpacker.read_map_header()):
        key = unpacker.unpack()
        if not isinstance(key, str):
            raise ValueError(f"{what}: a name is expected, not {key!r:.40}")
        yield key


def _values(unpacker: msgpack.Unpacker, what: str, wanted: Sequence[str]) -> Mapping[str, Any]:
    """Read the next map, which must have these keys."""
    values = unpacker.unpack()
    absent = [name for name in wanted if not isinstance(values, Mapping) or name not in values]
    if absent:
        raise ValueError(f"{what} has no `{absent[0]}`")
    return values


def _number(key: str, what: str) -> int:
    if not (key.isascii() and key.isdigit() and len(key) < 19):
        raise ValueError(f"a {what} is called {key[:40]!r} instead of by a number")
    return int(key)


def _floats(value: Any, shape: tuple[int, ...], what: str) -> NDArray[np.float64]:
    """Convert a value to finite numbers of this shape. The first dimension may be -1 for any length."""
    try:
        array = np.array(value, dtype=np.float64).reshape(shape)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{what} must be {' x '.join(str(n) for n in shape)} numbers") from None
    if not (np.abs(array) <= LARGEST).all():
        raise ValueError(f"{what} holds NaN or infinite numbers, or such beyond {LARGEST:g}")
    return array


def _camera(name: str, values: Any) -> Intrinsics:
    what = f"camera {name!r}"
    if not isinstance(values, Mapping):
        raise ValueError(f"{what} is no table")
    model = values.get("model_type")
    if model not in ("Perspective", "Fisheye"):
        raise ValueError(f"{what} is of model {model!r}; Perspective and Fisheye can be used")

    def number(key: str) -> float:
        value = values.get(key, 0.0 if key[0] in "kp" else None)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise ValueError(f"{what}: `{key}` must be a number")
        return float(value)

    try:
        # stella_vslam has pixel centres at whole numbers, as OpenCV does.
        fx, fy, cx, cy, width, height = map(number, ("fx", "fy", "cx", "cy", "cols", "rows"))
        camera = PinholeCamera(fx, fy, cx + 0.5, cy + 0.5, int(width), int(height))
    except ValueError as error:
        raise ValueError(f"{what}: {error}") from None
    if model == "Fisheye":
        lens = Distortion(tuple(map(number, ("k1", "k2", "k3", "k4"))), fisheye=True)
    else:
        lens = Distortion(tuple(map(number, ("k1", "k2", "k3"))), tangential=(number("p1"), number("p2")))
    try:
        return Intrinsics(*require_plausible(camera, lens, what))
    except InputError as error:
        raise ValueError(str(error)) from None


def _keyframe(unpacker: msgpack.Unpacker, key: str) -> _Keyframe:
    number = _number(key, "keyframe")
    what = f"keyframe {number}"
    values = _values(unpacker, what, ("ts", "cam", "rot_cw", "trans_cw", "undist_keypts", "lm_ids"))
    time = _floats(values["ts"], (), f"{what}: `ts`")
    rotation = _floats(values["rot_cw"], (1, 4), f"{what}: `rot_cw`")
    translation = _floats(values["trans_cw"], (1, 3), f"{what}: `trans_cw`")
    try:
        T_camera_world = poses_of_quaternions(translation, rotation, lambda _: what)[0]
    except InputError as error:
        raise ValueError(str(error).partition(";")[0]) from None

    ids, keypoints = values["lm_ids"], values["undist_keypts"]
    if not (isinstance(ids, list) and isinstance(keypoints, list) and len(ids) == len(keypoints)):
        raise ValueError(f"{what}: `lm_ids` and `undist_keypts` must be lists of one length")
    if not all(type(i) is int and -1 <= i < 1 << 62 for i in ids):
        raise ValueError(f"{what}: `lm_ids` must be whole numbers, -1 for none")
    numbers = np.array(ids, dtype=np.int64)
    seen = np.flatnonzero(numbers >= 0)
    places = [keypoints[i].get("pt") if isinstance(keypoints[i], Mapping) else None for i in seen]
    pixels = _floats(places, (len(seen), 2), f"{what}: the places of its keypoints") + 0.5
    # If a landmark has two keypoints, the first one is used.
    landmarks, first = np.unique(numbers[seen], return_index=True)
    return _Keyframe(number, float(time), str(values["cam"]), T_camera_world, landmarks, pixels[first])


def _landmark(unpacker: msgpack.Unpacker, key: str) -> NDArray[np.float64]:
    values = _values(unpacker, f"landmark {key}", ("pos_w",))
    return _floats(values["pos_w"], (3,), f"landmark {key}: `pos_w`")
