"""A ROS 2 node that maps live: it sends images, depths and the poses of tf to a run of MODP-Ti.

Start a run that waits at its socket, then the node, with the topics and the fixed frame of your robot:

    modp-ti run live.yaml      # source: {}, tracker: {kind: socket}, output: out/live
    python3 ros2_node.py --ros-args -p world:=odom -r image:=/camera/color/image_rect \
        -r depth:=/camera/aligned_depth_to_color/image_raw -r camera_info:=/camera/color/camera_info

Images must be rectified, and depths be those of the same pixels. The pose is that of the images' frame, which must be
an optical one (z forward, y down). The node needs ROS 2 and NumPy, and nothing of MODP-Ti: the messages are those of
docs/tracker_server.md.
"""

from __future__ import annotations

import socket
import struct

import numpy as np

HELLO, FRAME, END = 1, 2, 5
GREY, RGB, RGBA = 3, 4, 5
KNOWN, LOST = 1, 2
STEP = 24  # pixels between two points of a frame
FARTHEST = 8.0  # metres

# Encoding and order of the channels by ROS's names.
ENCODINGS = {
    "mono8": (GREY, [0]),
    "rgb8": (RGB, [0, 1, 2]),
    "bgr8": (RGB, [2, 1, 0]),
    "rgba8": (RGBA, [0, 1, 2, 3]),
    "bgra8": (RGBA, [2, 1, 0, 3]),
}


def message(kind: int, payload: bytes = b"") -> bytes:
    """A message of the tracker server: header and payload."""
    return struct.pack("<4sHHII", b"MODP", 1, kind, len(payload), 0) + payload


def hello(image, info) -> bytes:
    """The first message: the camera, by sensor_msgs/Image and sensor_msgs/CameraInfo."""
    encoding, _ = ENCODINGS[image.encoding]
    P = info.p
    camera = P[0], P[5], P[2] + 0.5, P[6] + 0.5  # ROS has pixel centres at whole numbers
    lens = [0.0] * 8  # none
    return message(HELLO, struct.pack("<IIII12d", image.width, image.height, encoding, 0, *camera, *lens) + b"ROS 2")


def frame(number: int, image, depth, info, transform) -> bytes:
    """The message of an image.

    Args:
        number: Number of the frame.
        image: sensor_msgs/Image.
        depth: sensor_msgs/Image of the depths of its pixels; None for no points.
        info: sensor_msgs/CameraInfo.
        transform: geometry_msgs/Transform from the camera to the world; None if it is not known.
    """
    pixels = picture(image)
    stamp = image.header.stamp
    T_world_camera = np.eye(4) if transform is None else matrix(transform)
    points = b"" if transform is None or depth is None else depth_points(number, metres(depth), info, T_world_camera)
    state, pose = (LOST if transform is None else KNOWN), np.linalg.inv(T_world_camera)
    head = struct.pack("<IId16d", number, state, stamp.sec + 1e-9 * stamp.nanosec, *pose.ravel())
    return message(FRAME, head + struct.pack("<II", len(points) // 48, len(pixels)) + points + pixels)


def picture(image) -> bytes:
    """The pixels of sensor_msgs/Image, in the order of `ENCODINGS`, without the ends of the rows."""
    channels = ENCODINGS[image.encoding][1]
    rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)[:, : image.width * len(channels)]
    return rows.reshape(image.height, image.width, len(channels))[..., channels].tobytes()


def metres(depth) -> np.ndarray:
    """The depths (H, W) [m] of sensor_msgs/Image; 0 or NaN where they are not known."""
    kind, unit = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}[depth.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if depth.is_bigendian else "<")
    rows = np.frombuffer(depth.data, np.uint8).reshape(depth.height, depth.step)[:, : depth.width * dtype.itemsize]
    return unit * np.ascontiguousarray(rows).view(dtype).astype(np.float64)


def matrix(transform) -> np.ndarray:
    """geometry_msgs/Transform as a matrix (4, 4)."""
    q, t = transform.rotation, transform.translation
    x, y, z, w = np.array([q.x, q.y, q.z, q.w]) / np.linalg.norm([q.x, q.y, q.z, q.w])
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), t.x],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), t.y],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), t.z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def depth_points(number: int, depth: np.ndarray, info, T_world_camera: np.ndarray) -> bytes:
    """Points on a grid of pixels: id, position in the world and pixel of each."""
    height, width = depth.shape
    rows, columns = (grid.ravel() for grid in np.mgrid[STEP // 2 : height : STEP, STEP // 2 : width : STEP])
    z = depth[rows, columns]
    good = (z > 0) & (z < FARTHEST)
    rows, columns, z = rows[good], columns[good], z[good]
    P = info.p
    in_camera = np.stack([(columns - P[2]) / P[0] * z, (rows - P[6]) / P[5] * z, z], axis=1)
    xyz = in_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    ids = number * 100_000 + np.arange(len(z))  # no two frames have a point in common
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    return b"".join(struct.pack("<q5d", *point) for point in zip(ids, *xyz.T, *pixels.T, strict=True))


def main() -> None:
    """Run the node."""
    import rclpy
    from message_filters import ApproximateTimeSynchronizer, Subscriber
    from rclpy.duration import Duration
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, Image
    from tf2_ros import Buffer, TransformException, TransformListener

    class Sender(Node):
        def __init__(self) -> None:
            super().__init__("modp_ti")
            self.world = self.declare_parameter("world", "odom").value
            address = self.declare_parameter("address", "127.0.0.1:7007").value
            host, _, port = address.rpartition(":")
            self.server = socket.create_connection((host, int(port)))
            self.number = 0
            self.tf = Buffer()
            self.listener = TransformListener(self.tf, self, spin_thread=True)
            topics = [(Image, "image"), (Image, "depth"), (CameraInfo, "camera_info")]
            inputs = [Subscriber(self, kind, name, qos_profile=qos_profile_sensor_data) for kind, name in topics]
            self.together = ApproximateTimeSynchronizer(inputs, queue_size=30, slop=0.02)
            self.together.registerCallback(self.arrived)

        def arrived(self, image, depth, info) -> None:
            if self.number == 0:
                self.server.sendall(hello(image, info))
            try:
                wait = Duration(seconds=0.2)
                found = self.tf.lookup_transform(self.world, image.header.frame_id, image.header.stamp, wait).transform
            except TransformException as error:
                self.get_logger().warning(f"no pose: {error}", throttle_duration_sec=5.0)
                found = None
            self.server.sendall(frame(self.number, image, depth, info, found))
            self.number += 1

    rclpy.init()
    node = Sender()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        node.server.sendall(message(END))


if __name__ == "__main__":
    main()
