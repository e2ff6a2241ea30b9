"""stella_vslam's map file in MessagePack: cameras, keyframes with their observations, and landmarks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import msgpack
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files import LARGEST, open_file, readable
from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import poses_of_quaternions
from modp_ti.inputs.sources import Distortion, Intrinsics
from modp_ti.inputs.sources.intrinsics import require_plausible

__all__ = ["StellaKeyframe", "StellaMap", "read_stella_map"]

# Bounds on lengths stated in the file. The reader allocates an array, including nested ones, when it reads the length,
# before it has seen the content.
MAX_ARRAY = 50_000  # the longest arrays are the keypoints of a keyframe
MAX_TEXT = 4096
MAX_ITEMS = 20_000_000  # keyframes or landmarks
MAX_BUFFER = 1 << 26  # bytes of one value
READ_SIZE = 1 << 20

WANTED = ("ts", "cam", "rot_cw", "trans_cw", "undist_keypts", "lm_ids")


@dataclass(frozen=True)
class StellaKeyframe:
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
class StellaMap:
    """Contents of a map file.

    Attributes:
        path: The file.
        cameras: Intrinsics by camera name.
        keyframes: Keyframes, ordered by time.
        landmarks: World position (3,) of each landmark by id.
    """

    path: Path
    cameras: dict[str, Intrinsics]
    keyframes: list[StellaKeyframe]
    landmarks: dict[int, NDArray[np.float64]]


class _DamagedError(Exception):
    """The file contains something that stella_vslam never writes; the message says what."""


def read_stella_map(path: Path) -> StellaMap:
    """Read the map from a `.msg` file. Descriptors and the graph between keyframes are skipped.

    Raises:
        InputError: If the file is missing, truncated, damaged, or has no keyframes or landmarks.
    """
    with readable(path, " (tracker.path)"), open_file(path) as file:
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
        except _DamagedError as error:
            raise InputError(f"{path}: {error}; the file is damaged or of another version of stella_vslam") from None
        except (ValueError, msgpack.UnpackException) as error:
            reason = " ".join(str(error).split())[:80] or type(error).__name__
            raise InputError(f"{path}: not a map of stella_vslam in MessagePack ({reason})") from None


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


def _read(path: Path, file: BinaryIO) -> StellaMap:
    unpacker = _unpacker(file)
    cameras: dict[str, Intrinsics] = {}
    keyframes: list[StellaKeyframe] = []
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
        raise _DamagedError(f"the map holds no `{next(iter(missing))}`")
    if not keyframes:
        raise InputError(f"{path}: the map holds no keyframe: stella_vslam did not initialise")
    if not landmarks:
        raise InputError(f"{path}: the map holds no landmark: nothing can be mapped from it")
    keyframes.sort(key=lambda keyframe: keyframe.time)
    for keyframe in keyframes:
        lost = next((i for i in keyframe.landmarks.tolist() if i not in landmarks), None)
        if lost is not None:
            raise _DamagedError(f"keyframe {keyframe.number} observes landmark {lost}, which the map lacks")
        if keyframe.camera not in cameras:
            raise _DamagedError(f"keyframe {keyframe.number} is of camera {keyframe.camera!r}, which the map lacks")
    for one, other in pairwise(keyframes):
        if one.time == other.time:
            raise _DamagedError(f"keyframes {one.number} and {other.number} are of one time ({one.time:.6f} s)")
    return StellaMap(path, cameras, keyframes, landmarks)


def _keys(unpacker: msgpack.Unpacker, what: str) -> Iterator[str]:
    """Yield the keys of the next map. The caller must consume each value before it requests the next key."""
    try:
        count = unpacker.read_map_header()
    except msgpack.OutOfData:
        raise
    except (ValueError, msgpack.UnpackException):
        raise _DamagedError(f"{what}: a table of names is expected") from None
    for _ in range(count):
        key = unpacker.unpack()
        if not isinstance(key, str):
            raise _DamagedError(f"{what}: a name is expected, not {key!r:.40}")
        yield key


def _values(unpacker: msgpack.Unpacker, what: str, wanted: Sequence[str]) -> dict[str, Any]:
    """Read the wanted values of the next map, which must have all of them. The others are skipped."""
    values: dict[str, Any] = {}
    for name in _keys(unpacker, what):
        if name in wanted:
            values[name] = unpacker.unpack()
        else:
            unpacker.skip()
    for name in wanted:
        if name not in values:
            raise _DamagedError(f"{what} has no `{name}`")
    return values


def _number(key: str, what: str) -> int:
    if not (key.isascii() and key.isdigit() and len(key) < 19):
        raise _DamagedError(f"a {what} is called {key[:40]!r} instead of by a number")
    return int(key)


def _floats(value: Any, shape: tuple[int, ...], what: str) -> NDArray[np.float64]:
    """Convert a value to finite numbers of this shape. The first dimension may be -1 for any length."""
    try:
        array = np.array(value, dtype=np.float64).reshape(shape)
    except (TypeError, ValueError, OverflowError):
        raise _DamagedError(f"{what} must be {' x '.join(str(n) for n in shape)} numbers") from None
    if not (np.abs(array) <= LARGEST).all():
        raise _DamagedError(f"{what} holds NaN or infinite numbers, or such beyond {LARGEST:g}")
    return array


def _camera(name: str, values: Any) -> Intrinsics:
    what = f"camera {name!r}"
    if not isinstance(values, Mapping):
        raise _DamagedError(f"{what} is no table")
    model = values.get("model_type")
    if model not in ("Perspective", "Fisheye"):
        raise _DamagedError(f"{what} is of model {model!r}; Perspective and Fisheye can be used")

    def number(key: str) -> float:
        value = values.get(key, 0.0 if key[0] in "kp" else None)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise _DamagedError(f"{what}: `{key}` must be a number")
        return float(value)

    try:
        # stella_vslam has pixel centres at whole numbers, as OpenCV does.
        fx, fy, cx, cy, width, height = map(number, ("fx", "fy", "cx", "cy", "cols", "rows"))
        camera = PinholeCamera(fx, fy, cx + 0.5, cy + 0.5, int(width), int(height))
    except ValueError as error:
        raise _DamagedError(f"{what}: {error}") from None
    if model == "Fisheye":
        lens = Distortion(tuple(map(number, ("k1", "k2", "k3", "k4"))), fisheye=True)
    else:
        lens = Distortion(tuple(map(number, ("k1", "k2", "k3"))), tangential=(number("p1"), number("p2")))
    try:
        return Intrinsics(*require_plausible(camera, lens, what))
    except InputError as error:
        raise _DamagedError(str(error)) from None


def _keyframe(unpacker: msgpack.Unpacker, key: str) -> StellaKeyframe:
    number = _number(key, "keyframe")
    what = f"keyframe {number}"
    values = _values(unpacker, what, WANTED)
    time = _floats(values["ts"], (), f"{what}: `ts`")
    rotation = _floats(values["rot_cw"], (1, 4), f"{what}: `rot_cw`")
    translation = _floats(values["trans_cw"], (1, 3), f"{what}: `trans_cw`")
    try:
        T_camera_world = poses_of_quaternions(translation, rotation, lambda _: what)[0]
    except InputError as error:
        raise _DamagedError(str(error).partition(";")[0]) from None

    ids, keypoints = values["lm_ids"], values["undist_keypts"]
    if not (isinstance(ids, list) and isinstance(keypoints, list) and len(ids) == len(keypoints)):
        raise _DamagedError(f"{what}: `lm_ids` and `undist_keypts` must be lists of one length")
    if not all(type(i) is int and -1 <= i < 1 << 62 for i in ids):
        raise _DamagedError(f"{what}: `lm_ids` must be whole numbers, -1 for none")
    numbers = np.array(ids, dtype=np.int64)
    seen = np.flatnonzero(numbers >= 0)
    places = [keypoints[i].get("pt") if isinstance(keypoints[i], Mapping) else None for i in seen]
    pixels = _floats(places, (len(seen), 2), f"{what}: the places of its keypoints") + 0.5
    # If a landmark has two keypoints, the first one is used.
    landmarks, first = np.unique(numbers[seen], return_index=True)
    return StellaKeyframe(number, float(time), str(values["cam"]), T_camera_world, landmarks, pixels[first])


def _landmark(unpacker: msgpack.Unpacker, key: str) -> NDArray[np.float64]:
    values = _values(unpacker, f"landmark {key}", ("pos_w",))
    return _floats(values["pos_w"], (3,), f"landmark {key}: `pos_w`")
