"""Corruptions of ROS bags: of the containers, and of single messages in them."""

from __future__ import annotations

import bz2
import sqlite3
import struct
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.fault_injection.corruptions import Corruption, changed
from tests.fault_injection.small_bag import write_small_bag
from tests.fault_injection.small_recording import HEIGHT, WIDTH

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

__all__ = ["CORRUPTED_BAGS"]

NAN = float("nan")
BOMB = 1 << 25  # bytes that a bomb unpacks to


def altered(topic: str, change: Callable[[Any], Any], depths: bool = False) -> Corruption:
    """Write the bag with the messages of a topic changed; those that become None are left out."""

    def corrupt(file: Path) -> None:
        file.unlink()
        write_small_bag(file, "mcap", lambda its, message: change(message) if its == topic else message, depths=depths)

    return corrupt


def fields(**values: Any) -> Callable[[Any], Any]:
    return lambda message: replace(message, **values)


def pose(position: Any = None, orientation: Any = None) -> Callable[[Any], Any]:
    """Change numbers of the pose of odometry: by name, of position and orientation."""

    def change(message: Any) -> Any:
        old = message.pose.pose
        new = replace(
            old,
            position=replace(old.position, **(position or {})),
            orientation=replace(old.orientation, **(orientation or {})),
        )
        return replace(message, pose=replace(message.pose, pose=new))

    return change


def named(frame: str) -> Callable[[Any], Any]:
    """Change the frame of a message."""
    return lambda message: replace(message, header=replace(message.header, frame_id=frame))


def matrix(place: int, value: float) -> Callable[[Any], Any]:
    """Change a number of K in CameraInfo."""

    def change(message: Any) -> Any:
        k = message.k.copy()
        k[place] = value
        return replace(message, k=k)

    return change


def later(message: Any) -> Any:
    header = message.header
    return replace(message, header=replace(header, stamp=replace(header.stamp, sec=header.stamp.sec + 86_400)))


def renamed_field(message: Any) -> Any:
    first, *others = message.fields
    return replace(message, fields=[replace(first, name="a"), *others])


def in_database(statement: str, *values: object) -> Corruption:
    def corrupt(file: Path) -> None:
        with sqlite3.connect(file) as database:
            database.execute(statement, values)
        database.close()

    return corrupt


def packed_bag(form: str, kind: str, start: bytes, bomb: bytes) -> Corruption:
    """Write the bag packed, and begin the content of its first chunk, which begins with `start`, by a bomb."""

    def corrupt(file: Path) -> None:
        file.unlink()
        write_small_bag(file, form, packed=kind)
        data = file.read_bytes()
        at = data.index(start)
        file.write_bytes(data[:at] + bomb + data[at + len(bomb) :])

    return corrupt


def put(offset: int, form: str, *values: int) -> Corruption:
    """Overwrite bytes at an offset, from the end if it is negative."""

    def content(data: bytes) -> bytes:
        at = offset % len(data)
        new = struct.pack(form, *values)
        return data[:at] + new + data[at + len(new) :]

    return changed(content)


def field_of(name: bytes, value: bytes) -> Corruption:
    """Overwrite the value of the first field of this name in a record of ROS 1."""

    def content(data: bytes) -> bytes:
        at = data.index(name + b"=") + len(name) + 1
        return data[:at] + value + data[at + len(value) :]

    return changed(content)


MESSAGES: dict[str, Corruption] = {
    "no images": altered("/image", lambda _: None),
    "no poses and transforms": altered("/odom", lambda _: None),
    "no camera": altered("/camera_info", lambda _: None),
    "a camera that is not calibrated": altered("/camera_info", matrix(0, 0.0)),
    "NaN for a focal length": altered("/camera_info", matrix(0, NAN)),
    "a negative focal length": altered("/camera_info", matrix(4, -40.0)),
    "a focal length of 1e300": altered("/camera_info", matrix(0, 1e300)),
    "a camera of another size": altered("/camera_info", fields(width=4800)),
    "a camera without a size": altered("/camera_info", fields(height=0)),
    "an unknown lens": altered("/camera_info", fields(distortion_model="omni", d=np.ones(5))),
    "a lens of 3": altered("/camera_info", fields(d=np.ones(3))),
    "a lens of 1e200": altered("/camera_info", fields(d=np.full(5, 1e200))),
    "NaN for a lens": altered("/camera_info", fields(d=np.full(5, NAN))),
    "an unknown encoding": altered("/image", fields(encoding="jpeg2000")),
    "an encoding of three times the bytes": altered("/image", fields(encoding="rgb8")),
    "images of 60000x60000": altered("/image", fields(width=60_000, height=60_000, step=60_000)),
    "images without a size": altered("/image", fields(width=0)),
    "a step that is too small": altered("/image", fields(step=3)),
    "images without data": altered("/image", fields(data=np.zeros(0, np.uint8))),
    "images of an unknown frame": altered("/image", named("elsewhere")),
    "images of another day": altered("/image", later),
    "NaN for positions": altered("/odom", pose({"x": NAN})),
    "positions of 1e20": altered("/odom", pose({"y": 1e20})),
    "quaternions of zeros": altered("/odom", pose(None, dict.fromkeys("xyzw", 0.0))),
    "quaternions of length 2": altered("/odom", pose(None, {"x": 0.0, "y": 0.0, "z": 0.0, "w": 2.0})),
    "quaternions of 1e200": altered("/odom", pose(None, {"w": 1e200})),
    "odometry of an unknown body": altered("/odom", fields(child_frame_id="elsewhere")),
    "no transform to the camera": altered("/tf_static", lambda _: None),
    "points without x": altered("/map", renamed_field),
    "fewer points than stated": altered("/map", fields(width=1 << 31)),
    "points of 2 bytes": altered("/map", fields(point_step=2)),
    "points of an unknown frame": altered("/map", named("elsewhere")),
    "points of nothing": altered("/map", fields(width=0, row_step=0, data=np.zeros(0, np.uint8))),
}


def depths(change: Callable[[Any], Any]) -> Corruption:
    """Change the depth images of a bag that has them instead of points."""
    return altered("/depth", change, depths=True)


def metres(value: float) -> Callable[[Any], Any]:
    """Replace all depths by one, in metres."""

    def change(message: Any) -> Any:
        data = np.full(message.width * message.height, value, "<f4").view(np.uint8)
        return replace(message, encoding="32FC1", step=4 * message.width, data=data)

    return change


DEPTHS: dict[str, Corruption] = {
    "no depth images": depths(lambda _: None),
    "depths of an unknown encoding": depths(fields(encoding="32FC2")),
    "depths of a colour image": depths(fields(encoding="rgb8")),
    "depths of four times the bytes": depths(fields(encoding="32FC1")),
    "depth images without data": depths(fields(data=np.zeros(0, np.uint8))),
    "depth images of 60000x60000": depths(fields(width=60_000, height=60_000, step=120_000)),
    "depth images without a size": depths(fields(width=0)),
    "depth images of another size": depths(fields(height=12)),
    "a step of depths that is too small": depths(fields(step=3)),
    "depths of an unknown frame": depths(named("elsewhere")),
    "depths of another day": depths(later),
    "depths of zero": depths(fields(data=np.zeros(2 * WIDTH * HEIGHT, np.uint8))),
    "NaN for depths": depths(metres(NAN)),
    "infinite depths": depths(metres(np.inf)),
    "negative depths": depths(metres(-3.0)),
    "depths of 1e30": depths(metres(1e30)),
    "no camera of the depths": altered("/camera_info", lambda _: None, depths=True),
    "no poses of the depths": altered("/odom", lambda _: None, depths=True),
    "no place of the depths' sensor": altered("/tf_static", lambda _: None, depths=True),
}

MCAP: dict[str, Corruption] = {
    "a profile of ROS 1": changed(lambda data: data.replace(b"ros2", b"ros1", 1)),
    "a header of 2^62 bytes": put(9, "<Q", 1 << 62),
    "a summary beyond the end": put(-28, "<Q", 1 << 62),
    "a summary in the middle of a record": put(-28, "<Q", 100),
    "records that are cut off": changed(lambda data: data[:400] + data[-37:]),
    "a bomb": packed_bag("mcap", "storage", b"\x28\xb5\x2f\xfd", zstd.compress(bytes(BOMB))),
}

ROS1: dict[str, Corruption] = {
    "another version": changed(lambda data: data.replace(b"V2.0", b"V1.2", 1)),
    "an index that is missing": field_of(b"index_pos", bytes(8)),
    "an index beyond the end": field_of(b"index_pos", struct.pack("<Q", 1 << 60)),
    "4 billion connections": field_of(b"conn_count", b"\xff\xff\xff\xff"),
    "4 billion chunks": field_of(b"chunk_count", b"\xff\xff\xff\xff"),
    "an unknown packing": field_of(b"compression", b"gzip"),
    "a header of 4 GB": put(13, "<I", 0xFFFFFFF0),
    "a bomb": packed_bag("ros1", "bz2", b"BZh", bz2.compress(bytes(BOMB))),
}

SQLITE3: dict[str, Corruption] = {
    "no table of messages": in_database("DROP TABLE messages"),
    "no topics": in_database("DELETE FROM topics"),
    "messages of text": in_database("UPDATE messages SET data = 'hello'"),
    "messages of zeros": in_database("UPDATE messages SET data = zeroblob(200)"),
    "times of text": in_database("UPDATE messages SET timestamp = 'now'"),
    "unknown types": in_database("UPDATE topics SET type = 'my_msgs/msg/Image'"),
    "exchanged types": in_database("UPDATE topics SET type = 'sensor_msgs/msg/Image'"),
    "topics without a name": in_database("UPDATE topics SET name = ''"),
    "a quality of service that is no YAML": in_database("UPDATE topics SET offered_qos_profiles = '[{a: '"),
    "a bomb": in_database("UPDATE messages SET data = ?", zstd.compress(bytes(BOMB))),
}

CORRUPTED_BAGS = {"mcap": MCAP | MESSAGES, "ros1": ROS1, "sqlite3": SQLITE3, "depth": DEPTHS}
"""Corruptions by the sample of a bag."""
