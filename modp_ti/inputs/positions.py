"""GPS positions of a recording, in its photographs (EXIF), video (GPMF) or bag, or in a file; and a video's gravity.

GPMF is nested records of big-endian numbers, each padded to four bytes:

    key (4), type (1; 0: holds records), bytes of an element (1), number of elements (2), the elements

Of a stream (`STRM`), `SCAL` divides the columns of the samples that follow, `TYPE` is the types of their columns, and
`GPSF` tells how many dimensions a fix has. A packet of the track holds the samples of its duration, evenly spaced.
"""

from __future__ import annotations

import csv
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import matrices_from_unit_quaternions
from modp_ti.files.errors import InputError
from modp_ti.files.reading import read_bytes, read_text, reading
from modp_ti.inputs.bags.bag import Bag, is_bag
from modp_ti.inputs.bags.transforms import seconds
from modp_ti.inputs.sources.image_header import photo_position
from modp_ti.inputs.sources.video_file import CONTAINERS, VIDEO_SUFFIXES

# Streams of GPMF with the columns of latitude, longitude and height: up to HERO10, from HERO11 on, of drones.
FIXES = {b"GPS5": (0, 1, 2), b"GPS9": (0, 1, 2), b"GLPI": (1, 2, 3)}
# Gravity in the axes of the camera, and the rotation (w, x, y, z) from these to the image's, which stabilisation turns.
# Both axes are OpenCV's: so the images and gyroscope of a GoPro Max agree to 1.3 degrees, in any other way less.
GRAVITY, TURN = b"GRAV", b"IORI"
STREAMS = {**FIXES, GRAVITY: (0, 1, 2), TURN: (0, 1, 2, 3)}
FIX = 8  # column of GPS9 with the dimensions of the fix
NUMBERS = dict(zip("bBsSlLjJfd", ("i1", "u1", ">i2", ">u2", ">i4", ">u4", ">i8", ">u8", ">f4", ">f8"), strict=True))
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
# Names of the columns of a CSV file.
COLUMNS = (("latitude", "lat"), ("longitude", "lon", "lng"), ("height", "altitude", "alt", "ele"))
# Times from here on are seconds since 1970, not of a recording.
SINCE_1970 = 1e8


@dataclass(frozen=True)
class Positions:
    """Where a recording was made.

    Attributes:
        geodetic: Latitude [degrees], longitude [degrees] and height [m] (N, 3) on WGS84; heights as the device gives
            them, over the ellipsoid or the sea.
        times: Times (N,) [s] on the clock of the frames; None where `names` tells.
        names: The frames' names.
    """

    geodetic: NDArray[np.float64]
    times: NDArray[np.float64] | None = None
    names: Sequence[str] | None = None


def recorded_positions(path: Path, names: Sequence[str]) -> Positions:
    """Read the positions that a recording holds.

    Args:
        path: A video, a bag, or a folder of photographs.
        names: Names of its frames, which are the paths of photographs in the folder.

    Raises:
        InputError: If it holds none.
    """
    with reading(path):
        if is_bag(path):
            rows = list(_of_bag(path))
        elif path.is_dir():
            there = {name: found for name in names if (found := photo_position(path / name)) is not None}
            if there:
                return Positions(np.array([*there.values()]), names=[*there])
            rows = []
        else:
            rows = [row for key, row in _telemetry(path) if key in FIXES]
    if not rows:
        raise InputError(f"{path}: holds no GPS positions; give a GPX or CSV file (--gps-file)")
    table = np.array(rows)
    return Positions(table[:, 1:], table[:, 0])


def recorded_gravity(path: Path, times: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the direction of gravity (F, 3) in the images of a video at times (F,) [s]; None if it holds none."""
    with reading(path):
        samples = [*_telemetry(path)] if path.is_file() else []
    gravity, turn = (np.array([row for key, row in samples if key == wanted]) for wanted in (GRAVITY, TURN))
    if len(gravity) == 0 or not gravity[:, 1:].any() or not gravity[0, 0] <= times.max() <= gravity[-1, 0] + 1.0:
        return None
    g = np.stack([np.interp(times, gravity[:, 0], column) for column in gravity[:, 1:].T], axis=1)
    if len(turn):
        q = np.stack([np.interp(times, turn[:, 0], column) for column in turn[:, 1:].T], axis=1)
        R = matrices_from_unit_quaternions(q / np.linalg.norm(q, axis=1, keepdims=True))
        g = np.einsum("nij,nj->ni", R, g)
    return g / np.linalg.norm(g, axis=1, keepdims=True)


def read_positions(path: Path, recording: Path, offset: float = 0.0) -> Positions:
    """Read a GPX file, or a CSV file with a header that names latitude, longitude, height, and time or image.

    Times since 1970 are taken to be on the clock of a video by its `creation_time`.

    Args:
        path: The file.
        recording: The video, if the recording is one.
        offset: Added to the file's times [s].

    Raises:
        InputError: If the file cannot be read, or has no position.
    """
    with reading(path):
        if path.suffix.lower() == ".gpx":
            named, rows = False, list(_of_gpx(path))
        else:
            named, rows = _of_csv(path)
        if not rows:
            raise InputError(f"{path}: holds no position with a time")
        geodetic = np.array([row[1:] for row in rows], dtype=np.float64)
        if named:
            return Positions(geodetic, names=[str(row[0]) for row in rows])
        times = np.array([float(row[0]) for row in rows]) + offset
        if times[0] > SINCE_1970 and recording.is_file() and not is_bag(recording):
            times -= _began(recording)
        return Positions(geodetic, times)


def _of_gpx(path: Path) -> Iterator[tuple[float, ...]]:
    for point in ElementTree.fromstring(read_bytes(path)).iter():
        parts = {child.tag.rpartition("}")[2]: child.text or "" for child in point}
        if "lat" in point.attrib and "time" in parts:
            height = float(parts.get("ele") or "nan")
            yield _since_1970(parts["time"]), float(point.attrib["lat"]), float(point.attrib["lon"]), height


def _of_csv(path: Path) -> tuple[bool, list[tuple[str | float, ...]]]:
    """Return whether the first column of the rows names images, and the rows."""
    table = csv.DictReader(read_text(path).splitlines())
    columns = {(name or "").strip().lower(): name for name in table.fieldnames or ()}
    named = "image" in columns
    key = columns["image" if named else "time" if "time" in columns else "timestamp"]
    places = [next(columns[name] for name in names if name in columns) for names in COLUMNS]
    return named, [(row[key], *(float(row[place]) for place in places)) for row in table]


def _of_bag(path: Path) -> Iterator[tuple[float, ...]]:
    bag = Bag(path)
    try:
        for topic in bag.of_types(NAV_SAT_FIX)[:1]:
            for _, message in bag.messages(topic):
                if message.status.status >= 0:
                    yield seconds(message.header.stamp), message.latitude, message.longitude, message.altitude
    finally:
        bag.close()


def _since_1970(text: str) -> float:
    time = datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
    return (time if time.tzinfo else time.replace(tzinfo=timezone.utc)).timestamp()


def _began(video: Path) -> float:
    """Return the time since 1970 [s] of a video's first frame, as its container states it."""
    import av

    with av.open(f"file:{video}", options={"format_whitelist": CONTAINERS, "protocol_whitelist": "file"}) as container:
        stated = container.metadata.get("creation_time")
    if stated is None:
        raise InputError(f"{video}: does not state when it was taken: give the positions its times, from 0")
    return _since_1970(stated)


def _telemetry(video: Path) -> Iterator[tuple[bytes, tuple[float, ...]]]:
    """Yield key, and time [s] and values of the samples of GPMF in a video; none of other files."""
    import av

    if video.suffix.lower() not in VIDEO_SUFFIXES:
        return
    options = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file"}
    with av.open(f"file:{video}", options=options, metadata_errors="replace") as container:
        # Without streams, PyAV would read the packets of all.
        for packet in container.demux(container.streams.data) if container.streams.data else ():
            if packet.pts is not None and packet.time_base and (data := bytes(packet))[:4] == b"DEVC":
                yield from _samples(
                    data, float(packet.pts * packet.time_base), float((packet.duration or 0) * packet.time_base)
                )


def _records(data: bytes) -> Iterator[tuple[bytes, bytes, int, int, bytes]]:
    """Yield key, type, size and number of the elements, and content of the records of GPMF."""
    at = 0
    while at + 8 <= len(data):
        key, kind, size, count = struct.unpack(">4scBH", data[at : at + 8])
        yield key, kind, size, count, data[at + 8 : at + 8 + size * count]
        at += 8 + -(-size * count // 4) * 4


def _samples(data: bytes, time: float, duration: float) -> Iterator[tuple[bytes, tuple[float, ...]]]:
    """Yield key, and time and values of the samples in a packet."""
    scale, types, fix = np.ones(1), "", 3
    for key, kind, size, count, content in _records(data):
        if kind == b"\0":
            yield from _samples(content, time, duration)
        elif key == b"SCAL":
            scale = np.frombuffer(content, NUMBERS[kind.decode()]).astype(np.float64)
        elif key == b"TYPE":
            types = content.decode("latin-1")
        elif key == b"GPSF":
            fix = int.from_bytes(content[:4], "big")
        elif key in STREAMS:
            letters = types or kind.decode() * (size // np.dtype(NUMBERS[kind.decode()]).itemsize)
            columns = np.frombuffer(content, [(str(n), NUMBERS[letter]) for n, letter in enumerate(letters)], count)
            for i, row in enumerate(columns.tolist()):
                if key not in FIXES or (row[FIX] if key == b"GPS9" else fix) >= 2:
                    values = (row[n] / scale[n % len(scale)] for n in STREAMS[key])
                    yield key, (time + i / count * duration, *values)
