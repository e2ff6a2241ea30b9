"""Parsing and validation of the messages. `docs/tracker_server.md` specifies them byte by byte."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints
from fields.geometry.camera import PinholeCamera
from modp_ti.files import LARGEST
from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import FARTHEST, checked_pose
from modp_ti.inputs.sources import NO_DISTORTION, Distortion, Intrinsics
from modp_ti.inputs.sources.undistortion import require_plausible

MAGIC = b"MODP"
VERSION = 1

# All numbers are little-endian, without padding.
HEADER = struct.Struct("<4sHHII")  # magic, version, kind, length of the payload, 0
HELLO = struct.Struct("<IIII4d8d")  # width, height, encoding, lens, fx fy cx cy, coefficients; then the tracker's name
FRAME = struct.Struct("<IId16dII")  # number, state, time, T_camera_world, counts of points and image bytes; then both
CORRECTION = struct.Struct("<II")  # counts of poses and points; then both
POINT = np.dtype([("id", "<i8"), ("xyz", "<f8", 3), ("pixel", "<f8", 2)])
MOVED_POSE = np.dtype([("number", "<u4"), ("zero", "<u4"), ("T", "<f8", (4, 4))])
MOVED_POINT = np.dtype([("id", "<i8"), ("xyz", "<f8", 3)])

# Limits: larger messages are refused before anything is allocated for them.
MAX_SIDE = 16_384  # [px]
MAX_PIXELS = 36_000_000  # an image of 8192x4320 fits
MAX_POINTS = 100_000  # of a frame
MAX_MOVED_POSES = 200_000  # of a correction
MAX_MOVED_POINTS = 1_000_000
MAX_NAME = 64  # bytes
MOST_BYTES_A_PIXEL = 4  # largest JPEG or PNG image, plus IMAGE_OVERHEAD bytes for its headers
IMAGE_OVERHEAD = 65_536

# A pose closer than this to a rigid one is used bit for bit, since its error is only float64 rounding.
ROUNDING = 1e-12


class ProtocolError(Exception):
    """A message is malformed or out of place. Its text is the one-line error that is sent back."""


class UnfitError(ProtocolError):
    """A well-formed message has unusable content. It is skipped, and the connection continues.

    Args:
        text: The error in one line.
        number: The frame that the message is about; None if it is not about one frame.
    """

    def __init__(self, text: str, number: int | None = None) -> None:
        super().__init__(text)
        self.number = number


class Kind(IntEnum):
    """The kind of a message. The server sends kinds from 64 on."""

    HELLO = 1
    FRAME = 2
    POSE = 3
    CORRECTION = 4
    END = 5
    WELCOME = 64
    DONE = 65
    ERROR = 66


class Encoding(IntEnum):
    """The image format. Pixels with alpha 0 are ignored, in RGBA8 and in PNG with alpha."""

    JPEG = 1
    PNG = 2
    GREY8 = 3
    RGB8 = 4
    RGBA8 = 5

    @property
    def channels(self) -> int | None:
        """Bytes per pixel of a raw encoding; None for a file format."""
        return {Encoding.GREY8: 1, Encoding.RGB8: 3, Encoding.RGBA8: 4}.get(self)


class State(IntEnum):
    """State of a frame's pose: sent later, known, or lost for good."""

    LATER = 0
    KNOWN = 1
    LOST = 2


@dataclass(frozen=True)
class Hello:
    """The first message: camera, image encoding and name of the tracker."""

    intrinsics: Intrinsics
    encoding: Encoding
    name: str

    @property
    def image_bytes(self) -> int:
        """Largest accepted size of one image in bytes; for raw encodings, the exact size."""
        pixels = self.intrinsics.camera.width * self.intrinsics.camera.height
        channels = self.encoding.channels
        return pixels * MOST_BYTES_A_PIXEL + IMAGE_OVERHEAD if channels is None else pixels * channels


@dataclass(frozen=True)
class Frame:
    """A FRAME message, or a POSE message, which has no image.

    Attributes:
        number: Frame number chosen by the sender.
        state: Whether the pose is known.
        timestamp: Time in seconds.
        T_camera_world: (4, 4); None unless `state` is KNOWN.
        points: Points that the frame sees, in pixels of the image as sent.
        image: The bytes of the image as sent.
        place: Place of the message's payload in the file of the stream.
    """

    number: int
    state: State
    timestamp: float
    T_camera_world: NDArray[np.float64] | None
    points: SparsePoints
    image: bytes
    place: int = 0


@dataclass(frozen=True)
class Correction:
    """Revised poses and points.

    Attributes:
        numbers: (N,) the sender's numbers of the revised frames.
        T_camera_world: (N, 4, 4) their poses.
        ids: (M,) ids of the revised points.
        xyz: (M, 3) their positions in the world.
    """

    numbers: NDArray[np.int64]
    T_camera_world: NDArray[np.float64]
    ids: NDArray[np.int64]
    xyz: NDArray[np.float64]


def encoded(kind: Kind, payload: bytes) -> bytes:
    """Encode a message with its header."""
    return HEADER.pack(MAGIC, VERSION, kind, len(payload), 0) + payload


def parse_header(data: bytes, hello: Hello | None) -> tuple[Kind, int]:
    """Parse a message header, and return the kind of the message and the size of its payload in bytes.

    Args:
        data: The 16 bytes of the header.
        hello: The connection's HELLO, which limits the size of images; None before it.

    Raises:
        ProtocolError: If the header is invalid, its kind is unknown or unexpected here, or its payload is too long or
            too short.
    """
    magic, version, kind, length, zero = HEADER.unpack(data)
    _require(magic == MAGIC, f"a message must begin with 'MODP', not with the bytes {magic.hex(' ')}")
    _require(version == VERSION, f"version {version} is not spoken here: send version {VERSION}")
    _require(zero == 0, f"the last 4 bytes of the header must be 0, not {zero}")
    known = (Kind.HELLO, Kind.FRAME, Kind.POSE, Kind.CORRECTION, Kind.END)
    _require(kind in known, f"message kind {kind} is not known: 1 HELLO, 2 FRAME, 3 POSE, 4 CORRECTION, 5 END")
    kind = Kind(kind)
    _require((kind is Kind.HELLO) == (hello is None), f"{kind.name}: HELLO must be the first message, and no other")
    least, most = {
        Kind.HELLO: (HELLO.size, HELLO.size + MAX_NAME),
        Kind.FRAME: (FRAME.size, FRAME.size + MAX_POINTS * POINT.itemsize + (hello.image_bytes if hello else 0)),
        Kind.POSE: (FRAME.size, FRAME.size + MAX_POINTS * POINT.itemsize),
        Kind.CORRECTION: (
            CORRECTION.size + MOVED_POSE.itemsize,
            CORRECTION.size + MAX_MOVED_POSES * MOVED_POSE.itemsize + MAX_MOVED_POINTS * MOVED_POINT.itemsize,
        ),
        Kind.END: (0, 0),
    }[kind]
    _require(least <= length <= most, f"a {kind.name} of {length} bytes: its payload has {least} to {most}")
    return kind, length


def parse_hello(payload: bytes) -> Hello:
    """Parse the payload of HELLO. Raises ProtocolError for an invalid camera, encoding or name."""
    width, height, encoding, lens, *numbers = HELLO.unpack_from(payload)
    (fx, fy, cx, cy), k = numbers[:4], numbers[4:]
    fits = 0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_PIXELS
    _require(fits, f"HELLO: images of {width}x{height} are not taken: at most {MAX_PIXELS:,} pixels")
    _require(encoding in tuple(Encoding), f"HELLO: image encoding {encoding} is not known: {_choices(Encoding)}")
    _require(all(map(math.isfinite, numbers)), "HELLO: intrinsics and distortion must be finite numbers")
    _require(fx > 0 and fy > 0, f"HELLO: focal lengths must be positive, not {fx:g} and {fy:g}")
    inside = -width < cx < 2 * width and -height < cy < 2 * height
    _require(inside, f"HELLO: the principal point ({cx:g}, {cy:g}) is far outside of {width}x{height} pixels")
    _require(lens in (0, 1, 2), f"HELLO: lens model {lens} is not known: 0 none, 1 k1 k2 p1 p2 k3 k4 k5 k6, 2 fisheye")
    used, distortion = (
        (0, NO_DISTORTION),
        (8, Distortion((k[0], k[1], k[4]), tuple(k[5:8]), (k[2], k[3]))),
        (4, Distortion(tuple(k[:4]), fisheye=True)),
    )[lens]
    _require(not any(k[used:]), f"HELLO: lens model {lens} has {used} coefficients, the others must be 0")
    try:
        name = payload[HELLO.size :].decode("utf-8")
    except UnicodeDecodeError:
        raise ProtocolError("HELLO: the tracker's name must be UTF-8") from None
    try:
        intrinsics = require_plausible(PinholeCamera(fx, fy, cx, cy, width, height), distortion, "HELLO")
    except InputError as error:
        raise ProtocolError(str(error)) from None
    # The name is printed to the terminal, so control characters are removed.
    name = "".join(c if c.isalnum() or c in " ._-" else "?" for c in name)
    return Hello(Intrinsics(*intrinsics), Encoding(encoding), name)


def parse_frame(payload: bytes, kind: Kind, place: int = 0) -> Frame:
    """Parse the payload of a FRAME, or of a POSE, which has the same layout without an image.

    Args:
        payload: The payload.
        kind: FRAME or POSE.
        place: As in `Frame`.

    Raises:
        ProtocolError: If sizes disagree, or the state is invalid here.
        UnfitError: If the pose, the time stamp or a point is invalid.
    """
    number, state, timestamp, *matrix, count, length = FRAME.unpack_from(payload)
    what = f"{kind.name} {number}"
    _require(count <= MAX_POINTS, f"{what}: {count} points, at most {MAX_POINTS} are taken")
    middle = FRAME.size + count * POINT.itemsize
    size, had = middle + length, len(payload)
    _require(
        size == had, f"{what}: {count} points and {length} bytes of image make {size} bytes, its payload has {had}"
    )
    is_frame = kind is Kind.FRAME
    _require((length > 0) == is_frame, f"{what}: {'has no image' if is_frame else 'must have no image'}")
    _require(state in tuple(State), f"{what}: state {state} is not known: {_choices(State)}")
    state = State(state)
    brings = is_frame or state is not State.LATER
    _require(brings, f"{what}: must bring the pose (state 1) or say that none will come (state 2)")
    _require(not count or state is State.KNOWN, f"{what}: has points and no pose: they come with it")
    if not abs(timestamp) <= LARGEST:
        raise UnfitError(f"{what}: the time stamp is not finite, or beyond {LARGEST:g}", number)
    try:
        pose = _pose(np.array(matrix).reshape(4, 4), what) if state is State.KNOWN else None
        points = parse_points(payload[FRAME.size : middle], what)
    except UnfitError as error:
        error.number = number
        raise
    return Frame(number, state, timestamp, pose, points, payload[middle:], place)


def parse_points(block: bytes, what: str) -> SparsePoints:
    """Parse the points of a frame. Raises UnfitError, whose message begins with `what`, if they are invalid."""
    table = _points(block, POINT, what)
    xyz, pixels = (table[name].astype(np.float64) for name in ("xyz", "pixel"))
    return SparsePoints(xyz, pixels, table["id"].astype(np.int64))


def parse_correction(payload: bytes) -> Correction:
    """Parse the payload of a CORRECTION.

    Raises:
        ProtocolError: If sizes disagree, or there is no pose.
        UnfitError: If a pose or point is invalid, frames are not in increasing order, or a point is listed twice.
    """
    poses, points = CORRECTION.unpack_from(payload)
    middle = CORRECTION.size + poses * MOVED_POSE.itemsize
    size = middle + points * MOVED_POINT.itemsize
    had = len(payload)
    _require(poses > 0 and size == had, f"CORRECTION: {poses} poses, {points} points make {size} bytes, it has {had}")
    frames = np.frombuffer(payload[CORRECTION.size : middle], dtype=MOVED_POSE)
    numbers = frames["number"].astype(np.int64)
    if (np.diff(numbers) <= 0).any():
        raise UnfitError("CORRECTION: frames must be named once each, in their order")
    matrices = [_pose(row["T"], f"CORRECTION of frame {row['number']}") for row in frames]
    moved = _points(payload[middle:], MOVED_POINT, "CORRECTION")
    return Correction(numbers, np.stack(matrices), moved["id"].astype(np.int64), moved["xyz"].astype(np.float64))


def _require(holds: bool, otherwise: str) -> None:
    if not holds:
        raise ProtocolError(otherwise)


def _points(block: bytes, layout: np.dtype, what: str) -> NDArray:
    """Read a table of points, whose ids must be unique and whose coordinates must be finite."""
    table = np.frombuffer(block, dtype=layout)
    if not all((np.abs(table[name]) <= FARTHEST).all() for name in layout.fields or () if name != "id"):
        raise UnfitError(f"{what}: its points hold NaN or infinite numbers, or such beyond {FARTHEST:g}")
    if len(np.unique(table["id"])) != len(table):
        raise UnfitError(f"{what}: a point stands twice: send each id once")
    return table


def _pose(matrix: NDArray[np.float64], what: str) -> NDArray[np.float64]:
    try:
        pose = checked_pose(matrix, what)
    except InputError as error:
        raise UnfitError(str(error)) from None
    exact = np.abs(matrix - pose).max() < ROUNDING
    return np.array(matrix, dtype=np.float64) if exact else pose


def _choices(of: type[IntEnum]) -> str:
    return ", ".join(f"{each.value} {each.name}" for each in of)
