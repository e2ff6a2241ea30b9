"""Messages of a bag by topic, in order or at random. The containers are read by `rosbags`."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

from modp_ti.files import open_file, reading
from modp_ti.files.errors import InputError

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

SUFFIXES = (".bag", ".db3", ".mcap")
"""Suffixes of bags: ROS 1, and ROS 2 by sqlite3 and MCAP."""

VIDEO = "foxglove_msgs/msg/CompressedVideo"
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", VIDEO)
INFO = "sensor_msgs/msg/CameraInfo"
CLOUD = "sensor_msgs/msg/PointCloud2"
# In the order in which they are preferred.
POSES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
# Topics of poses that are where a robot should go, or where an operator says that it is.
COMMANDS = re.compile("goal|initial_?pose|set_?point|target|way_?point|command|clicked", re.IGNORECASE)
TREES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
STATIC = "tf_static"  # last part of the topic of transforms that hold for all times

# Programs that mend a bag that was cut off, by its suffix.
MENDS = {".bag": "rosbag reindex", ".mcap": "mcap recover"}
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True)
class Place:
    """Where the bag holds a message.

    Attributes:
        file: Number of the file.
        written: Time at which the message was recorded [ns].
        number: Number of the message among those of its topic that were recorded at that time.
    """

    file: int
    written: int
    number: int


def is_bag(path: Path) -> bool:
    """Whether the path is a file with a bag's suffix, or a folder that ROS 2 has recorded, or that holds only a bag."""
    if path.is_dir():
        files = _files(path)
        if os.path.isfile(path / "metadata.yaml"):
            return bool(files)
        whole = {re.sub("_[0-9]+$", "", file.stem) if file.suffix != ".bag" else file.stem for file in files}
        return len(whole) == 1 and set(files) == set(path.iterdir())
    return path.suffix in SUFFIXES


def has_poses(path: Path) -> bool:
    """Whether a bag holds poses or transforms that change. Raises InputError if it cannot be read."""
    bag = Bag(path)
    moving = any(topic.rpartition("/")[2] != STATIC for topic in [*bag.pose_topics, *bag.of_types(*TREES)])
    bag.close()
    return moving


def _files(path: Path) -> list[Path]:
    """Return the files of a bag, in the order of their numbers."""
    if not path.is_dir():
        return [path]
    found = [file for file in path.iterdir() if file.suffix in SUFFIXES and os.path.isfile(file)]
    return sorted(found, key=lambda file: (len(file.name), file.name))


class Bag:
    """A bag of ROS 1 or ROS 2, in one file or in a folder of them.

    Message types are those that ROS ships. Definitions in the bag are not used: `rosbags` would turn them into code.
    `read` may be called from several threads.

    Args:
        path: The file or folder.

    Attributes:
        path: The file or folder.
        topics: Message type of each topic that has messages.

    Raises:
        InputError: If it is no bag, or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.exists():
            raise InputError(f"{path}: no such bag (source.path)")
        files = _files(path)
        if not files:
            raise InputError(f"{path}: holds no bag: no file with the suffix {', '.join(SUFFIXES)} (source.path)")
        if len({file.suffix for file in files}) > 1:
            raise InputError(f"{path}: holds bags of several kinds: name one of the files in source.path")
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._lock = Lock()
        self._first = files[0].suffix == ".bag"
        self._types = get_typestore(Stores.ROS1_NOETIC if self._first else Stores.ROS2_HUMBLE)
        # Foxglove's type begins with a time and a frame, which are the bytes of a header.
        self._types.register(get_types_from_msg("std_msgs/Header header\nuint8[] data\nstring format", VIDEO))
        if self._first:  # the types that ROS 1 ships separately
            for kind in TREES:
                self._types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
        self._readers: list[Reader1 | Reader2] = []
        try:
            for file in files:
                with reading(file, " (source.path)"), open_file(file):
                    pass
                if file.suffix == ".db3" and set(str(file)) & set("?#%"):
                    raise InputError(f"{file}: SQLite cannot open a path with ?, # or %: rename it (source.path)")
                with self._damaged(file):
                    reader = (Reader1 if self._first else Reader2)(file)
                    try:
                        reader.open()
                    except Exception:
                        with suppress(Exception):  # it may not have got as far as a file
                            reader.close()
                        raise
                    self._readers.append(reader)
            with self._damaged(path):
                self.topics = {c.topic: c.msgtype for r in self._readers for c in r.connections if c.msgcount > 0}
        except InputError:
            self.close()
            raise

    def of_types(self, *types: str) -> list[str]:
        """Return the topics of these message types, by type and then by name."""
        return [topic for kind in types for topic, its in sorted(self.topics.items()) if its == kind]

    @property
    def pose_topics(self) -> list[str]:
        """The topics of poses, by type and then by name, without those of commands."""
        return [topic for topic in self.of_types(*POSES) if not COMMANDS.search(topic)]

    def chosen(self, topic: str, types: tuple[str, ...], setting: str) -> str:
        """Return a topic that the user has named. Raises InputError if there is none of these types."""
        if self.topics.get(topic) not in types:
            there = ", ".join(self.of_types(*types)) or "none"
            raise InputError(f"{self.path}: has no {types[0]} or the like at {topic}; there is {there} ({setting})")
        return topic

    def messages(self, topic: str) -> Iterator[tuple[Place, Any]]:
        """Yield the messages of a topic with their places, in the order in which they were recorded.

        Raises:
            InputError: If the bag is damaged.
        """
        with self._damaged(self.path):
            for n, reader in enumerate(self._readers):
                before, number = -1, 0
                for written, raw in self._raw(reader, topic):
                    number = number + 1 if written == before else 0
                    before = written
                    yield Place(n, written, number), self._message(raw, topic)

    def first(self, topic: str) -> Any:
        """Return the first message of a topic. Raises InputError if the bag is damaged."""
        messages = self.messages(topic)
        try:
            return next(messages)[1]
        except StopIteration:
            raise InputError(f"{self.path}: has no message of {topic}; it is damaged") from None
        finally:
            messages.close()  # pyright: ignore[reportAttributeAccessIssue]  # a generator

    def read(self, topic: str, place: Place) -> Any:
        """Return the message of a topic at a place. Raises InputError if the bag is damaged."""
        with self._lock, self._damaged(self.path):
            found = self._raw(self._readers[place.file], topic, place.written)
            raw = [raw for _, raw in found][place.number]
            return self._message(raw, topic)

    def close(self) -> None:
        """Close the files."""
        for reader in self._readers:
            reader.close()
        self._readers.clear()

    def _raw(self, reader: Reader1 | Reader2, topic: str, written: int | None = None) -> Iterator[tuple[int, bytes]]:
        """Yield time of recording [ns] and content of the messages of a topic, of those of one time if it is given."""
        mine = [c for c in reader.connections if c.topic == topic and c.msgtype == self.topics[topic]]
        if mine:
            for _, time, raw in reader.messages(mine, written, None if written is None else written + 1):
                yield time, raw

    def _message(self, raw: bytes, topic: str) -> Any:
        kind = self.topics[topic]
        if self._first:
            return self._types.deserialize_ros1(raw, kind)
        return self._types.deserialize_cdr(_unpacked(raw), kind)

    @contextmanager
    def _damaged(self, file: Path) -> Iterator[None]:
        """Report what `rosbags` raises as an InputError. It checks little, so that damaged files can raise anything."""
        mend = MENDS.get(file.suffix, "ros2 bag reindex")
        with reading(file, f"; if it was cut off, `{mend} {file.name}` mends it (source.path)"):
            yield


def _unpacked(raw: bytes) -> bytes:
    """Unpack a message of ROS 2 that is packed. Those that are not begin with a zero byte."""
    if not raw.startswith(ZSTD_MAGIC):
        return raw
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd.decompress(raw)
