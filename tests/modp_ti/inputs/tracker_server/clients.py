"""A server with somebody before it: connections that send bytes written out by hand."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from fields.frames.tracked_frame import TrackedFrame
from modp_ti.inputs.protocol import Event
from modp_ti.inputs.readers.socket import SocketSettings
from modp_ti.inputs.source_settings import SourceSettings
from modp_ti.inputs.tracker_server import TrackerServer
from tests.patience import PATIENCE

HELLO, FRAME, POSE, CORRECTION, END = 1, 2, 3, 4, 5
WELCOME, DONE, ERROR = 64, 65, 66
SIZE = (8, 6)


@contextmanager
def opened(path: Path, patience: float = 20.0, **source: object) -> Iterator[TrackerServer]:
    tracker = TrackerServer(SourceSettings(**source), SocketSettings(path=path, patience=patience))
    try:
        yield tracker
    finally:
        tracker.close()


def connect(path: Path) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.settimeout(PATIENCE)
    connection.connect(str(path))
    return connection


def message(
    kind: int, payload: bytes = b"", magic: bytes = b"MODP", version: int = 1, length: int | None = None
) -> bytes:
    return struct.pack("<4sHHII", magic, version, kind, len(payload) if length is None else length, 0) + payload


def hello(width: int = SIZE[0], height: int = SIZE[1], encoding: int = 4, lens: int = 0, fx: float = 9.0) -> bytes:
    return struct.pack("<IIII12d", width, height, encoding, lens, fx, 9.5, width / 2, height / 2, *[0.0] * 8)


def pose(x: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def frame(
    number: int,
    state: int = 1,
    time: float | None = None,
    T: np.ndarray | None = None,
    points: bytes = b"",
    count: int | None = None,
    image: bytes | None = None,
) -> bytes:
    """A frame of one colour, which tells its number; raw RGB unless given."""
    image = bytes([number] * (SIZE[0] * SIZE[1] * 3)) if image is None else image
    matrix = (np.zeros((4, 4)) if state != 1 else pose(0.1 * number)) if T is None else T
    head = struct.pack("<IId16d", number, state, 0.1 * number if time is None else time, *matrix.ravel())
    return head + struct.pack("<II", len(points) // 48 if count is None else count, len(image)) + points + image


def late(number: int, state: int = 1, T: np.ndarray | None = None, points: bytes = b"") -> bytes:
    """The payload of a POSE."""
    return frame(number, state, 0.0, T, points, image=b"")


def point(i: int, x: float, y: float, z: float, u: float, v: float) -> bytes:
    return struct.pack("<q5d", i, x, y, z, u, v)


def correction(poses: dict[int, np.ndarray], points: dict[int, tuple[float, float, float]]) -> bytes:
    data = struct.pack("<II", len(poses), len(points))
    for number, T in poses.items():
        data += struct.pack("<II16d", number, 0, *T.ravel())
    for i, xyz in points.items():
        data += struct.pack("<q3d", i, *xyz)
    return data


def answer(connection: socket.socket) -> tuple[int, bytes]:
    """The server's next message."""
    data = b""
    while len(data) < 16:
        part = connection.recv(16 - len(data))
        assert part, "the server said nothing"
        data += part
    magic, version, kind, length, zero = struct.unpack("<4sHHII", data)
    assert (magic, version, zero) == (b"MODP", 1, 0)
    payload = b""
    while len(payload) < length:
        payload += connection.recv(length - len(payload))
    return kind, payload


def greeted(path: Path) -> socket.socket:
    connection = connect(path)
    connection.sendall(message(HELLO, hello()))
    assert answer(connection) == (WELCOME, b"")
    return connection


def colours(events: Iterable[Event]) -> list[int]:
    """The numbers that the frames were sent with."""
    return [int(event.rgba[0, 0, 0]) for event in events if isinstance(event, TrackedFrame)]
