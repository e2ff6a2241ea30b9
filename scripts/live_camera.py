"""Play a video or a folder of images as a camera: MJPEG over HTTP on the loopback, for one reader.

The first image is sent when the reader asks for the stream, and the others at their times, whatever the reader does. As
in a camera's driver, a few images wait for a slow reader; what comes while they wait is dropped and counted.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import socket
import struct
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from modp_ti.files import read_bytes
from modp_ti.files.atomic import replace_text
from modp_ti.files.errors import InputError

__all__ = ["Show", "add_show_options", "environment", "playing", "read_log", "send_on_time", "show_of"]

# Images that wait for the reader, as many as a driver usually has buffers.
BUFFERS = 4
# Bytes that the system keeps for the reader. Its own choice would hide seconds of images.
SYSTEM_BUFFER = 1 << 16
# How long the camera waits for its reader, and after the last image for the reader to take it [s].
WAIT, LAST_WAIT = 600.0, 10.0
QUALITY = 95
HEADER = (
    b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\nCache-Control: no-store\r\n\r\n"
)
PART = "--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {}\r\n\r\n"


@dataclass(frozen=True)
class Show:
    """What the camera shows.

    Attributes:
        path: A video or a folder of images.
        rate: Images per second, None for their own times.
        frames: Number of images, None for all. If there are fewer, they are shown back and forth.
        start: Position of the first image.
        stall: (n, seconds): a pause before image n, by which all later ones are late.
        cut: Number of the image in the middle of which the stream ends.
        unplug: Number of the image before which the connection is reset.
    """

    path: Path
    rate: float | None = None
    frames: int | None = None
    start: int = 0
    stall: tuple[int, float] | None = None
    cut: int | None = None
    unplug: int | None = None

    @property
    def faults(self) -> list[str]:
        """The faults in a few words each."""
        stall = self.stall and f"stalls for {self.stall[1]:g} s at image {self.stall[0]}"
        cut = None if self.cut is None else f"ends in the middle of image {self.cut}"
        unplug = None if self.unplug is None else f"unplugged at image {self.unplug}"
        return [fault for fault in (stall, cut, unplug) if fault]

    def arguments(self) -> list[str]:
        """The command line of this program that plays it."""
        arguments = [str(self.path), "--start", str(self.start)]
        for name in ("rate", "frames", "cut", "unplug"):
            if (value := getattr(self, name)) is not None:
                arguments += [f"--{name}", str(value)]
        if self.stall is not None:
            arguments += ["--stall", *map(str, self.stall)]
        return arguments


def add_show_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a `Show` except its path."""
    parser.add_argument("--rate", type=float, metavar="FPS", help="images a second (default: at their own times)")
    parser.add_argument("--frames", type=int, metavar="N", help="number of images; back and forth if there are fewer")
    parser.add_argument("--start", type=int, default=0, metavar="N", help="position of the first image")
    parser.add_argument(
        "--stall", nargs=2, type=float, metavar=("N", "SECONDS"), help="send nothing for some seconds before image N"
    )
    parser.add_argument("--cut", type=int, metavar="N", help="end in the middle of image N")
    parser.add_argument("--unplug", type=int, metavar="N", help="reset the connection before image N")


def show_of(arguments: argparse.Namespace, path: Path) -> Show:
    """Return the show that the options ask for. Raises InputError if they cannot be meant."""
    if arguments.rate is not None and arguments.rate <= 0:
        raise InputError(f"--rate {arguments.rate:g}: give images per second, above 0")
    if arguments.frames is not None and arguments.frames < 1:
        raise InputError(f"--frames {arguments.frames}: give at least 1")
    stall = None if arguments.stall is None else (int(arguments.stall[0]), arguments.stall[1])
    return Show(path, arguments.rate, arguments.frames, arguments.start, stall, arguments.cut, arguments.unplug)


@dataclass
class Sent:
    """What the camera did.

    Attributes:
        times: Unix time [s] at which each image was due; None for those that were dropped.
        late: Largest delay between that time and the beginning of the sending [s], by which the camera was not exact.
        gone: Whether the reader went away.
    """

    times: list[float | None] = field(default_factory=list)
    late: float = 0.0
    gone: bool = False

    @property
    def dropped(self) -> int:
        """Number of images that were dropped because the reader took none."""
        return self.times.count(None)


def load(show: Show) -> tuple[list[bytes], list[float]]:
    """Return the JPEG images of a show and their times from the first [s]. Stored JPEG files are sent as they are."""
    # Imported here, as are the readers' libraries: the sessions that start this process need only `playing`.
    import cv2

    from modp_ti.config.settings import SourceSettings
    from modp_ti.inputs.opening import open_source
    from modp_ti.inputs.sources.listed_images import ListedImages

    stop = None if show.frames is None else show.start + show.frames
    images = open_source(SourceSettings(path=show.path.resolve(), start=show.start, stop=stop, scale=1.0))
    names = images.selected(show.start, stop, 1)
    encoded = []
    for name in names:
        if isinstance(images, ListedImages) and name.lower().endswith((".jpg", ".jpeg")):
            encoded.append(read_bytes(images.path / name))
        else:
            picture = cv2.cvtColor(images.read(name), cv2.COLOR_RGB2BGR)
            encoded.append(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes())
    times = [images.timestamp(name) - images.timestamp(names[0]) for name in names]
    images.close()
    return encoded, times


def schedule(show: Show, times: Sequence[float]) -> list[tuple[float, int]]:
    """Return the time from the start [s] and the position of every image that is shown."""
    count = len(times) if show.frames is None else show.frames
    period = max(2 * len(times) - 2, 1)
    there = [min(i % period, period - i % period) for i in range(count)]
    if show.rate is not None:
        due = [i / show.rate for i in range(count)]
    else:
        due = [0.0]
        for before, after in pairwise(there):
            due.append(due[-1] + abs(times[after] - times[before]))
    if show.stall is not None:
        due = [time + show.stall[1] * (i >= show.stall[0]) for i, time in enumerate(due)]
    return list(zip(due, there, strict=True))


def send_on_time(
    connection: socket.socket, images: Sequence[bytes], due: Sequence[tuple[float, int]], show: Show
) -> Sent:
    """Send the images at their times, without ever waiting for the reader.

    Args:
        connection: The connection, on which the reader has asked for the stream.
        images: JPEG images.
        due: For each one to send, the time from now [s] and its position in `images`.
        show: Says where the stream fails.
    """
    connection.setblocking(False)
    waiting, sent = deque([memoryview(HEADER)]), Sent()
    start, clock = time.monotonic(), time.time() - time.monotonic()
    try:
        for number, (after, position) in enumerate(due):
            if number == show.unplug:
                # A reset instead of an orderly end: what the reader has not taken is lost.
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                return sent
            _push(connection, waiting, start + after)
            sent.late = max(sent.late, time.monotonic() - (start + after))
            if len(waiting) >= BUFFERS:
                sent.times.append(None)
                continue
            data = PART.format(len(images[position])).encode() + images[position] + b"\r\n"
            if number == show.cut:
                data = data[: len(data) // 2]
            waiting.append(memoryview(data))
            if number == show.cut:
                break
            sent.times.append(clock + start + after)
        _push(connection, waiting, time.monotonic() + LAST_WAIT, until_sent=True)
    except OSError:
        sent.gone = True
    return sent


def _push(connection: socket.socket, waiting: deque[memoryview], end: float, until_sent: bool = False) -> None:
    """Send what waits until the time `end`; no longer than needed if `until_sent`.

    What the connection takes at once is sent in any case, so that a camera that is late itself drops nothing.
    """
    while True:
        try:
            while waiting:
                rest = waiting[0][connection.send(waiting[0]) :]
                if rest:
                    waiting[0] = rest
                else:
                    waiting.popleft()
        except BlockingIOError:
            pass
        left = end - time.monotonic()
        if left <= 0 or (until_sent and not waiting):
            return
        if waiting:
            select.select([], [connection], [], left)
        else:
            time.sleep(left)


def serve(show: Show, port: int, log: Path | None) -> None:
    """Wait for a reader, play to it, and write what was sent to the file `log`."""
    images, times = load(show)
    due = schedule(show, times)
    with socket.create_server(("127.0.0.1", port)) as server:
        # Inherited by the connection; on the connection itself it would come too late.
        server.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SYSTEM_BUFFER)
        print(f"http://127.0.0.1:{server.getsockname()[1]}/camera.mjpg", flush=True)
        server.settimeout(WAIT)
        try:
            connection, _ = server.accept()
            connection.settimeout(WAIT)
            request = b""
            while b"\r\n\r\n" not in request:
                if not (part := connection.recv(4096)):
                    raise InputError("the reader asked for nothing")
                request += part
        except TimeoutError:
            raise InputError(f"no reader came within {WAIT:g} s") from None
        with connection:
            sent = send_on_time(connection, images, due, show)
    if log is not None:
        replace_text(log, json.dumps({"times": sent.times, "late": sent.late, "gone": sent.gone}) + "\n")
    words = [f"{len(sent.times) - sent.dropped} of {len(due)} images sent", f"{sent.dropped} dropped"]
    print(", ".join([*words, *(["the reader went away"] if sent.gone else [])]), file=sys.stderr)


def environment() -> dict[str, str]:
    """Return the environment of a process that is started: it imports what this one imports."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


@contextmanager
def playing(show: Show, log: Path) -> Iterator[str]:
    """Play a show in a process of its own, and yield its URL. At the end the process is stopped.

    Args:
        show: What to play.
        log: File for what was sent: `times`, `late` and `gone` of `Sent`.

    Raises:
        InputError: If the images cannot be read.
    """
    command = [sys.executable, str(Path(__file__).resolve()), *show.arguments(), "--log", str(log)]
    log.unlink(missing_ok=True)
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment())
    try:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        if not url:
            process.wait()
            raise InputError(f"{show.path}: cannot be played as a camera")
        yield url
        if process.poll() is None:
            process.wait(LAST_WAIT)
    except subprocess.TimeoutExpired:
        pass  # the reader ended the recording before the show did
    finally:
        process.terminate()
        process.wait()


def read_log(log: Path) -> dict[str, Any]:
    """Read what a camera sent; empty if it was stopped before it ended."""
    return json.loads(log.read_text(encoding="utf-8")) if log.is_file() else {}


def main() -> None:
    """Run the command line."""
    from ending import documented_ending

    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: scripts/live_camera.py room.mp4 --rate 10 --port 8090, and in another terminal: "
        "modp-ti run --stream http://127.0.0.1:8090/camera.mjpg",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("path", type=Path, help="video or folder of images")
    add_show_options(parser)
    parser.add_argument("--port", type=int, default=0, help="port on the loopback (default: a free one)")
    parser.add_argument("--log", type=Path, metavar="FILE", help="JSON file for the times at which images were sent")
    arguments = parser.parse_args()
    with documented_ending():
        serve(show_of(arguments, arguments.path), arguments.port, arguments.log)


if __name__ == "__main__":
    main()
