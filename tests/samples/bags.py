"""Bags of ROS 1 and ROS 2 with views of known cameras and poses, written by `rosbags`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from tests.samples.filmed import Filmed, View

# T_link_optical: from a camera's axes in ROS's optical frame to those of a body (x forward, y left, z up).
OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
# T_base_link, of the camera's body on the robot.
BASE_LINK = np.eye(4)
BASE_LINK[:3, :3] = Rotation.from_euler("zyx", [20.0, -10.0, 5.0], degrees=True).as_matrix()
BASE_LINK[:3, 3] = (0.2, -0.1, 0.4)
BODY_CAMERA = BASE_LINK @ OPTICAL
START, STEP = 1_700_000_000_000_000_000, 100_000_000  # time of the first view, and between views [ns]

FORMS = ("ros1", "sqlite3", "mcap")


class Messages:
    """Makes messages of ROS 1 or ROS 2."""

    def __init__(self, form: str = "mcap") -> None:
        self.first = form == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.first else Stores.ROS2_HUMBLE)
        if self.first:
            for kind in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
                self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))

    def make(self, kind: str, *values: Any) -> Any:
        package, name = kind.split("/")
        return self.store.types[f"{package}/msg/{name}"](*values)

    def header(self, time: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/Time", time // 10**9, time % 10**9)
        return self.make("std_msgs/Header", *([0] if self.first else []), stamp, frame)

    def image(self, time: int, values: NDArray, encoding: str, frame: str = "optical", padding: int = 0) -> Any:
        """`values`: (H, W) or (H, W, C), big-endian ones as such. Rows end with `padding` bytes."""
        height, width = values.shape[:2]
        rows = np.frombuffer(values.tobytes(), np.uint8).reshape(height, -1)
        rows = np.hstack([rows, np.full((height, padding), 77, np.uint8)])
        big = int(values.dtype.byteorder == ">")
        header = self.header(time, frame)
        return self.make("sensor_msgs/Image", header, height, width, encoding, big, rows.shape[1], rows.reshape(-1))

    def compressed(self, time: int, data: bytes, form: str = "jpeg", frame: str = "optical") -> Any:
        return self.make("sensor_msgs/CompressedImage", self.header(time, frame), form, np.frombuffer(data, np.uint8))

    def info(
        self,
        time: int,
        K: NDArray,
        size: tuple[int, int],
        model: str = "plumb_bob",
        D: Sequence[float] = (0.0,) * 5,
        frame: str = "optical",
    ) -> Any:
        """`K`: with pixel centres at +0.5."""
        there = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        P = np.hstack([there, np.zeros((3, 1))])
        roi = self.make("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        matrices = [np.array(D, float), there.ravel(), np.eye(3).ravel(), P.ravel()]
        header = self.header(time, frame)
        return self.make("sensor_msgs/CameraInfo", header, size[1], size[0], model, *matrices, 0, 0, roi)

    def quaternion(self, T: NDArray) -> Any:
        return self.make("geometry_msgs/Quaternion", *Rotation.from_matrix(T[:3, :3]).as_quat().tolist())

    def pose(self, T: NDArray) -> Any:
        return self.make("geometry_msgs/Pose", self.make("geometry_msgs/Point", *T[:3, 3].tolist()), self.quaternion(T))

    def pose_stamped(self, time: int, T: NDArray, frame: str = "world") -> Any:
        return self.make("geometry_msgs/PoseStamped", self.header(time, frame), self.pose(T))

    def odometry(self, time: int, T: NDArray, frame: str = "odom", child: str = "base") -> Any:
        still = self.make("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
        twist = self.make("geometry_msgs/Twist", still, still)
        return self.make(
            "nav_msgs/Odometry",
            self.header(time, frame),
            child,
            self.make("geometry_msgs/PoseWithCovariance", self.pose(T), np.zeros(36)),
            self.make("geometry_msgs/TwistWithCovariance", twist, np.zeros(36)),
        )

    def transform(self, time: int, parent: str, child: str, T: NDArray) -> Any:
        moved = self.make("geometry_msgs/Vector3", *T[:3, 3].tolist())
        transform = self.make("geometry_msgs/Transform", moved, self.quaternion(T))
        return self.make("geometry_msgs/TransformStamped", self.header(time, parent), child, transform)

    def tree(self, *transforms: Any) -> Any:
        return self.make("tf2_msgs/TFMessage", list(transforms))

    def cloud(self, time: int, xyz: NDArray, frame: str = "odom") -> Any:
        """Points with an intensity after the coordinates, in rows that end with four bytes."""
        big = xyz.dtype.byteorder == ">"
        form = xyz.dtype.str
        kind = 7 if xyz.dtype.itemsize == 4 else 8
        record = np.dtype([("x", form), ("y", form), ("z", form), ("intensity", "u1")])
        packed = np.zeros(len(xyz), record)
        for axis, column in zip("xyz", xyz.T, strict=True):
            packed[axis] = column
        data = np.append(np.frombuffer(packed.tobytes(), np.uint8), np.zeros(4, np.uint8))
        fields = [
            self.make("sensor_msgs/PointField", name, record.fields[name][1], kind if name in "xyz" else 2, 1)
            for name in record.names
        ]
        header, step = self.header(time, frame), record.itemsize
        return self.make("sensor_msgs/PointCloud2", header, 1, len(xyz), fields, big, step, len(data), data, True)


def write_bag(
    path: Path,
    form: str,
    messages: Iterable[tuple[str, int, Any]],
    packed: str = "",
    defined: bool = True,
    store: Any = None,
) -> Path:
    """Write topic, time of recording [ns] and content of messages, and return the path of the bag.

    form: `ros1` (a file), `sqlite3` or `mcap` (folders). packed: how chunks are packed by ROS 1, or what by ROS 2.
    defined: whether the bag has the definitions of the messages. store: their types, those of ROS if None.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    store = Messages(form).store if store is None else store
    if form == "ros1":
        writer: Any = Writer1(path)
        if packed:
            writer.set_compression(Writer1.CompressionFormat[packed.upper()])
        definition = {} if defined else {"msgdef": "", "md5sum": "*"}
    else:
        writer = Writer2(path, version=9, storage_plugin=StoragePlugin[form.upper()])
        if packed:
            writer.set_compression(CompressionMode[packed.upper()], CompressionFormat.ZSTD)
        definition = {} if defined else {"msgdef": "", "rihs01": "RIHS01_0"}
    connections: dict[str, Any] = {}
    with writer:
        for topic, time, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store, **definition)
            serialize = store.serialize_ros1 if form == "ros1" else store.serialize_cdr
            writer.write(connections[topic], time, serialize(message, kind))
    return path


def recording(
    views: Sequence[View], form: str = "mcap", change: Callable[[str, NDArray], NDArray] = lambda _, T: T
) -> list[tuple[str, int, Any]]:
    """Messages of a robot that has taken these views: images, CameraInfo, odometry and transforms.

    change: returns another transform for the name of a child frame.
    """
    make = Messages(form)
    mounts = (("base", "link", BASE_LINK), ("link", "optical", OPTICAL))
    fixed = make.tree(*(make.transform(0, parent, child, change(child, T)) for parent, child, T in mounts))
    messages: list[tuple[str, int, Any]] = [("/tf_static", START - STEP, fixed)]
    for n, view in enumerate(views):
        time = START + n * STEP
        late = time + STEP // 3  # recorded later than it was taken
        T = change("base", view.T_world_camera @ np.linalg.inv(BODY_CAMERA))
        messages.append(("/odom", late, make.odometry(time, T)))
        messages.append(("/tf", late, make.tree(make.transform(time, "odom", "base", T))))
        image = np.ascontiguousarray(view.image[..., ::-1])
        messages.append(("/camera/image_raw", late + 1, make.image(time, image, "rgb8")))
        messages.append(("/camera/camera_info", late + 1, make.info(time, view.K, view.size)))
    return messages


def write_small_bag(file: Path, form: str, filmed: Filmed, depths: bool = False) -> None:
    """Write grey images, their camera, odometry, transforms, and points or depth images, to one file."""
    make = Messages(form)
    messages: list[tuple[str, int, Any]] = [("/tf_static", 1, make.tree(make.transform(0, "base", "optical", OPTICAL)))]
    if not depths:
        messages.append(("/map", 2, make.cloud(1, filmed.points.astype("<f4"))))
    for i, view in enumerate(filmed.views):
        time = i * 10**8 + 10**9
        messages.append(("/odom", time, make.odometry(time, view.T_world_camera @ np.linalg.inv(OPTICAL))))
        messages.append(("/image", time, make.image(time, np.ascontiguousarray(view.image[..., 1]), "mono8")))
        messages.append(("/camera_info", time, make.info(time, view.K, view.size)))
        if depths:
            millimetres = np.round(1000 * view.depth(view.K, view.size)).astype("<u2")
            messages.append(("/depth", time, make.image(time, millimetres, "16UC1")))
    with TemporaryDirectory() as folder:
        written = write_bag(Path(folder) / "bag", form, messages, defined=False)
        content = written if form == "ros1" else next(each for each in written.iterdir() if each.suffix == file.suffix)
        file.write_bytes(content.read_bytes())
