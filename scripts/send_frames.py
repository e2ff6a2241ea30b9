"""Send the frames of any scene to a run with `tracker: {kind: socket}`, as an external tracker would.

The messages are implemented from docs/tracker_server.md with only the standard library and NumPy, as an example to
start from.
"""

from __future__ import annotations

import argparse
import os
import socket
import struct
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

HELLO, FRAME, POSE, CORRECTION, END = 1, 2, 3, 4, 5
WELCOME, DONE, ERROR = 64, 65, 66
JPEG, PNG, GREY8, RGB8, RGBA8 = 1, 2, 3, 4, 5
LATER, KNOWN, LOST = 0, 1, 2

NOWHERE = np.zeros((4, 4))
NO_POINTS = (np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0, dtype=np.int64))
Pose = NDArray[np.float64]
# World points (N, 3), their pixels (N, 2) and ids (N,).
Points = tuple[NDArray, NDArray, NDArray]


class ServerError(Exception):
    """The server reported an error, closed the connection or cannot be reached."""


class Sender:
    """Client for `tracker: {kind: socket}`; docs/tracker_server.md describes the messages.

    Args:
        address: "host:port", or the path of a Unix socket.
        wait: How long to wait for the run to listen [s].
    """

    def __init__(self, address: str, wait: float = 60.0) -> None:
        self.socket = _connected(address, time.monotonic() + wait)

    def hello(self, width: int, height: int, intrinsics: Sequence[float], encoding: int, name: str = "") -> None:
        """Send the camera without distortion (fx, fy, cx, cy [px], pixel centres at +0.5), and wait for the answer."""
        self.send(HELLO, struct.pack("<IIII4d8d", width, height, encoding, 0, *intrinsics, *[0.0] * 8) + name.encode())
        self.expect(WELCOME)

    def frame(
        self,
        number: int,
        timestamp: float,
        image: bytes,
        T_camera_world: Pose | None = None,
        points: Points = NO_POINTS,
    ) -> None:
        """Send a frame. Without its (4, 4) pose, `pose` sends it later, with its points."""
        state = LATER if T_camera_world is None else KNOWN
        self.send(FRAME, _frame(number, state, timestamp, T_camera_world, points, image))

    def pose(self, number: int, T_camera_world: Pose | None, points: Points = NO_POINTS) -> None:
        """Send the pose of a frame that was sent without one, None if tracking was lost."""
        self.send(POSE, _frame(number, LOST if T_camera_world is None else KNOWN, 0.0, T_camera_world, points, b""))

    def correction(
        self, numbers: NDArray, T_camera_world: NDArray, ids: NDArray | None = None, xyz: NDArray | None = None
    ) -> None:
        """Send revised poses (N, 4, 4) of the frames with these ascending numbers, and positions (M, 3) of points."""
        ids, xyz = (np.zeros(0), np.zeros((0, 3))) if ids is None or xyz is None else (ids, xyz)
        payload = struct.pack("<II", len(numbers), len(ids))
        for number, T in zip(numbers, T_camera_world, strict=True):
            payload += struct.pack("<II", number, 0) + np.ascontiguousarray(T, dtype="<f8").tobytes()
        for i, place in zip(ids, xyz, strict=True):
            payload += struct.pack("<q3d", i, *place)
        self.send(CORRECTION, payload)

    def end(self) -> int:
        """Announce the end, and return the number of frames that were passed to the mapper, once all were."""
        self.send(END, b"")
        return struct.unpack("<I", self.expect(DONE))[0]

    def send(self, kind: int, payload: bytes) -> None:
        """Send a message. Blocks while the run has enough frames to work on."""
        try:
            self.socket.sendall(struct.pack("<4sHHII", b"MODP", 1, kind, len(payload), 0) + payload)
        except OSError as error:
            raise ServerError(self._last_words() or f"the connection is gone: {error}") from None

    def expect(self, kind: int) -> bytes:
        """Receive the payload of the server's next message. Raises ServerError if the message is of another kind."""
        _, _, answer, length, _ = struct.unpack("<4sHHII", self._read(16))
        payload = self._read(length)
        if answer != kind:
            raise ServerError(payload.decode() if answer == ERROR else f"unexpected answer {answer}")
        return payload

    def _read(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            part = self.socket.recv(size - len(data))
            if not part:
                raise ServerError("the server has closed the connection")
            data += part
        return data

    def _last_words(self) -> str | None:
        try:
            return self.expect(ERROR).decode()
        except (ServerError, OSError):
            return None


def _frame(
    number: int, state: int, timestamp: float, T_camera_world: Pose | None, points: Points, image: bytes
) -> bytes:
    xyz, pixels, ids = points
    table = np.zeros(len(ids), dtype=[("id", "<i8"), ("xyz", "<f8", 3), ("pixel", "<f8", 2)])
    table["id"], table["xyz"], table["pixel"] = ids, xyz, pixels
    T = NOWHERE if T_camera_world is None else T_camera_world
    head = struct.pack(
        "<IId16dII", number, state, timestamp, *np.asarray(T, dtype=np.float64).ravel(), len(ids), len(image)
    )
    return head + table.tobytes() + image


def _connected(address: str, deadline: float) -> socket.socket:
    while True:
        try:
            if "/" in address or os.path.exists(address):
                connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
                connection.connect(address)
                return connection
            host, _, port = address.rpartition(":")
            return socket.create_connection((host.strip("[]"), int(port)))
        except OSError as error:
            if time.monotonic() > deadline:
                raise ServerError(f"{address}: nobody listens there: {error}") from None
            time.sleep(0.2)


def play(
    scene: Path, overrides: Sequence[str], address: str, wait: float, late: int = 0, rate: float | None = None
) -> int:
    """Send a scene's frames as its tracker delivers them, and return how many were passed to the mapper.

    Args:
        scene: Scene file.
        overrides: `KEY=VALUE` settings.
        address: See `Sender`, as `wait`.
        wait: How long to wait for the run to listen [s].
        late: Send poses and points this many frames after their images; 0 sends them together.
        rate: Maximum frames per second, None for no limit.
    """
    from fields.frames.pose_correction import PoseCorrection
    from modp_ti.config.scene_file import load_scene
    from modp_ti.inputs.opening import open_tracker

    tracker = open_tracker(load_scene(scene, overrides))
    waiting: deque = deque()  # what `Sender.pose` takes, of the frames that were sent without their poses
    next_time = time.monotonic()
    sender: Sender | None = None
    camera = None
    try:
        for event in tracker:
            if isinstance(event, PoseCorrection):
                assert sender is not None, "frames come before their corrections"
                while waiting:  # the frames that it revises must have poses
                    sender.pose(*waiting.popleft())
                sender.correction(event.index, event.T_camera_world, event.ids, event.xyz)
                continue
            if sender is None:  # connect late, as the server drops silent clients
                camera = c = event.camera
                sender = Sender(address, wait)
                sender.hello(c.width, c.height, (c.fx, c.fy, c.cx, c.cy), RGBA8, name="send_frames")
            if event.camera != camera:
                raise ServerError(f"{event.name} has another camera than the first frame: the server takes one")
            if rate is not None:
                time.sleep(max(next_time - time.monotonic(), 0.0))
                next_time = max(next_time + 1.0 / rate, time.monotonic())
            placed = event.T_camera_world, (event.points.xyz, event.points.pixels, event.points.ids)
            sender.frame(event.index, event.timestamp, event.rgba.tobytes(), *(() if late else placed))
            if late:
                waiting.append((event.index, *placed))
                if len(waiting) > late:
                    sender.pose(*waiting.popleft())
        if sender is None:
            return 0
        while waiting:
            sender.pose(*waiting.popleft())
        return sender.end()
    finally:
        tracker.close()


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: scripts/send_frames scene.yaml --to 127.0.0.1:7007 --late 3",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", type=Path, help="scene file whose frames are sent, whatever its tracker")
    parser.add_argument("--to", default="127.0.0.1:7007", metavar="ADDRESS", help="host:port, or a Unix socket's path")
    parser.add_argument("--late", type=int, default=0, metavar="N", help="send each pose and its points N frames late")
    parser.add_argument("--rate", type=float, metavar="FPS", help="frames a second at most")
    parser.add_argument("--wait", type=float, default=60.0, help="seconds in which the run may still start to listen")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override of the scene file")
    arguments = parser.parse_args()
    from ending import documented_ending  # imported here because `Sender` is also used on its own

    with documented_ending(ServerError):
        taken = play(arguments.scene, arguments.set, arguments.to, arguments.wait, arguments.late, arguments.rate)
        print(f"{taken} frames taken")


if __name__ == "__main__":
    main()
