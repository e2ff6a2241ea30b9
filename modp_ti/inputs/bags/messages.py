"""Messages of images, depths, cameras and clouds as arrays."""

from __future__ import annotations

import io
import re
import struct
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.trajectory import FARTHEST
from modp_ti.inputs.bags.bag import VIDEO
from modp_ti.inputs.capture import checked_numbers, plausible_camera
from modp_ti.inputs.sources.distortion import NO_DISTORTION, lens_of_model
from modp_ti.inputs.sources.image_header import decodable, read_image_header
from modp_ti.inputs.sources.image_pixels import DEPTHS, decoded, decoded_as, reduced
from modp_ti.inputs.sources.undistortion import Intrinsics

DEPTH_ENCODINGS = ("16UC1", "32FC1")
COMPRESSED = "sensor_msgs/msg/CompressedImage"
# By what the messages of a video may state.
CODECS = {"h264": "h264", "avc": "h264", "h265": "h265", "hevc": "h265"}
# The start of a unit of parameters in the stream of a codec.
PARAMETERS = {"h264": re.compile(rb"\0\0\x01[\x07\x27\x47\x67]"), "h265": re.compile(rb"\0\0\x01[\x40\x42]")}
# Before the PNG of a compressed depth image: its format, and two parameters of inverse depths.
DEPTH_HEADER = struct.Struct("<iff")
# Types of a cloud's coordinates by PointField's `datatype`.
FLOATS = {7: "f4", 8: "f8"}


class Layout(NamedTuple):
    """How an encoding stores a pixel: type and number of its values, and OpenCV's conversion to RGB if it needs one."""

    dtype: str
    channels: int
    conversion: str | None


LAYOUTS = {
    "rgb8": Layout("u1", 3, None),
    "bgr8": Layout("u1", 3, "COLOR_BGR2RGB"),
    "8UC3": Layout("u1", 3, "COLOR_BGR2RGB"),
    "rgba8": Layout("u1", 4, "COLOR_RGBA2RGB"),
    "bgra8": Layout("u1", 4, "COLOR_BGRA2RGB"),
    "8UC4": Layout("u1", 4, "COLOR_BGRA2RGB"),
    "mono8": Layout("u1", 1, "COLOR_GRAY2RGB"),
    "8UC1": Layout("u1", 1, "COLOR_GRAY2RGB"),
    "mono16": Layout("u2", 1, "COLOR_GRAY2RGB"),
    "rgb16": Layout("u2", 3, None),
    "bgr16": Layout("u2", 3, "COLOR_BGR2RGB"),
    "yuv422": Layout("u1", 2, "COLOR_YUV2RGB_UYVY"),
    "uyvy": Layout("u1", 2, "COLOR_YUV2RGB_UYVY"),
    "yuv422_yuy2": Layout("u1", 2, "COLOR_YUV2RGB_YUY2"),
    "yuyv": Layout("u1", 2, "COLOR_YUV2RGB_YUY2"),
    # OpenCV names a pattern by its second row and column.
    **{
        f"bayer_{pattern}{bits}": Layout(f"u{bits // 8}", 1, f"COLOR_Bayer{name}2RGB")
        for pattern, name in (("rggb", "BG"), ("bggr", "RG"), ("gbrg", "GR"), ("grbg", "GB"))
        for bits in (8, 16)
    },
}
"""Encodings of sensor_msgs/Image that are read."""


def is_compressed(message: Any) -> bool:
    """Whether an image message is a sensor_msgs/CompressedImage, or the like for video."""
    return message.__msgtype__ in (COMPRESSED, VIDEO)


def video_codec(message: Any) -> str | None:
    """Return the codec of an image message that holds a picture of a video, None for others."""
    stated = message.format.lower() if is_compressed(message) else ""
    return next((codec for name, codec in CODECS.items() if name in stated), None)


def begins_video(message: Any) -> bool:
    """Whether a picture of a video can be decoded without those before: it brings the stream's parameters."""
    return PARAMETERS[str(video_codec(message))].search(message.data.tobytes()) is not None


def is_depth(message: Any) -> bool:
    """Whether an image message holds depths."""
    return "compressedDepth" in message.format if is_compressed(message) else message.encoding in DEPTH_ENCODINGS


def is_grey(message: Any) -> bool:
    """Whether an image message is known to be grey."""
    stated = message.format if is_compressed(message) else message.encoding
    return stated.startswith(("mono", "8UC1"))


def is_deep(message: Any) -> bool:
    """Whether an image message has 16 bits per channel."""
    layout = None if is_compressed(message) else LAYOUTS.get(message.encoding)
    return layout is not None and layout.dtype == "u2"


def picture_size(message: Any) -> tuple[int, int] | None:
    """Return the size (width, height) that an image message states; None if it states none, or is cut off."""
    if not is_compressed(message):
        return (message.width, message.height) if message.width > 0 and message.height > 0 else None
    with suppress(OSError):
        header = read_image_header(io.BytesIO(message.data.tobytes()))
        return header.width, header.height
    return None


def picture(message: Any, bits: int = DEPTHS[-1]) -> NDArray[np.uint8]:
    """Return an image message as (H, W, 3) uint8 RGB.

    Args:
        message: A sensor_msgs/Image or sensor_msgs/CompressedImage.
        bits: How many bits an image of 16 bits per channel uses.

    Raises:
        ValueError: If its encoding is not supported, or it is damaged.
    """
    import cv2

    if is_compressed(message):
        data = message.data.tobytes()
        decodable(data)
        image = decoded(data)
        if image is None:
            raise ValueError("it is damaged or no image")
        return image
    layout = LAYOUTS.get(message.encoding)
    if layout is None:
        raise ValueError(f"the encoding {message.encoding[:40]!r} is not supported ({', '.join(LAYOUTS)})")
    values = reduced(stored_values(message, layout.dtype, layout.channels), bits)
    if layout.conversion is None:
        return values
    try:
        return np.asarray(cv2.cvtColor(values, getattr(cv2, layout.conversion)), np.uint8)
    except cv2.error:
        raise ValueError(f"{message.width}x{message.height} pixels cannot be of {message.encoding}") from None


def stored_values(message: Any, dtype: str, channels: int = 1) -> NDArray:
    """Return the values of a sensor_msgs/Image, (H, W) or (H, W, C), in the machine's byte order.

    Raises:
        ValueError: If the message holds fewer.
    """
    width, height, step = message.width, message.height, message.step
    row = width * channels * np.dtype(dtype).itemsize
    if min(width, height) < 1 or step < row or message.data.size < step * height:
        raise ValueError(f"it holds {message.data.size} bytes, in rows of {step}, for {width}x{height} pixels")
    rows = np.ascontiguousarray(message.data[: step * height].reshape(height, step)[:, :row])
    values = rows.view(f"{'>' if message.is_bigendian else '<'}{dtype}").astype(dtype, copy=False)
    return values if channels == 1 else values.reshape(height, width, channels)


def depth_metres(message: Any) -> NDArray[np.float32]:
    """Return the depths (H, W) [m] of an image message; 0 or NaN where they are unknown.

    Raises:
        ValueError: If it is damaged, or holds no depths.
    """
    if not is_compressed(message):
        if message.encoding == "32FC1":
            return stored_values(message, "f4")
        return np.divide(stored_values(message, "u2"), 1000.0, dtype=np.float32)
    import cv2

    data = message.data.tobytes()
    head, png = data[: DEPTH_HEADER.size], data[DEPTH_HEADER.size :]
    decodable(png)
    stored = decoded_as(png, cv2.IMREAD_UNCHANGED)
    if stored is None or stored.ndim != 2 or stored.dtype != np.uint16:
        raise ValueError("it holds no grey picture of 16 bits")
    if not message.format.startswith("32FC1"):
        return np.divide(stored, 1000.0, dtype=np.float32)
    _, scale, offset = DEPTH_HEADER.unpack(head)
    with np.errstate(all="ignore"):  # parameters of a damaged message
        return np.where(stored > 0, np.float32(scale) / (stored.astype(np.float32) - np.float32(offset)), np.float32(0))


def cloud_points(message: Any) -> NDArray[np.float64]:
    """Return the finite points (N, 3) of a PointCloud2 message, in its own frame.

    Raises:
        ValueError: If it has no coordinates of float32 or float64, or fewer bytes than it states.
    """
    order = ">" if message.is_bigendian else "<"
    fields = {field.name: field for field in message.fields}
    if not all(axis in fields and fields[axis].datatype in FLOATS for axis in "xyz"):
        raise ValueError("it has no fields x, y and z of float32 or float64")
    step, row, width, height = message.point_step, message.row_step, message.width, message.height
    formats = [order + FLOATS[fields[axis].datatype] for axis in "xyz"]
    offsets = [fields[axis].offset for axis in "xyz"]
    end = max(offset + np.dtype(form).itemsize for offset, form in zip(offsets, formats, strict=True))
    if step < end or row < width * step or message.data.size < row * height:
        raise ValueError(f"it holds {message.data.size} bytes, in rows of {row}, for {width}x{height} points of {step}")
    packed = np.ascontiguousarray(message.data[: row * height].reshape(height, row)[:, : width * step])
    record = np.dtype({"names": list("xyz"), "formats": formats, "offsets": offsets, "itemsize": step})
    points = packed.reshape(-1).view(record) if packed.size else np.zeros(0, record)
    with np.errstate(all="ignore"):  # converting a signalling NaN to float64 warns
        xyz = np.stack([points[axis].astype(np.float64) for axis in "xyz"], axis=1)
    return xyz[(np.abs(xyz) <= FARTHEST).all(axis=1)]


def camera_of_info(message: Any, rectified: bool, where: str) -> Intrinsics | None:
    """Return the camera of a CameraInfo message; None if it says that it is not calibrated.

    Args:
        message: The message, of ROS 1 or ROS 2.
        rectified: Whether the images are rectified, so that the camera is that of `P`.
        where: Start of the error message.

    Raises:
        InputError: If it is no possible camera, or its lens model is not supported.
    """
    values = {name.lower(): list(map(float, getattr(message, name))) for name in "DKPdkp" if hasattr(message, name)}
    K, P = checked_numbers(values["k"], 9, f"{where}: K"), checked_numbers(values["p"], 12, f"{where}: P")
    fx, fy, cx, cy = (P[0], P[5], P[2], P[6]) if rectified else (K[0], K[4], K[2], K[5])
    if fx == 0.0:
        return None
    D = checked_numbers(values["d"], len(values["d"]), f"{where}: D")
    lens = NO_DISTORTION if rectified else lens_of_model(message.distortion_model, D, where)
    # The calibration has pixel centres at whole numbers.
    camera = plausible_camera(fx, fy, cx + 0.5, cy + 0.5, (message.width, message.height), where, lens)
    return Intrinsics(camera, lens)


def info_beside(topic: str, infos: list[str]) -> str | None:
    """Return the topic of CameraInfo that belongs to a topic of images, or None.

    It lies beside the images. The topic of compressed images lies below that of the images.
    """
    above = topic.rpartition("/")[0]
    while True:
        for beside in (f"{above}/camera_info", f"{above}/info/camera_info"):  # the second one is of RealSense Viewer
            if beside in infos:
                return beside
        if not above:
            return infos[0] if len(infos) == 1 else None
        above = above.rpartition("/")[0]


def is_rectified(topic: str) -> bool:
    """Whether the images of a topic are rectified, by its name."""
    name = topic.removesuffix("/compressed").removesuffix("/compressedDepth").rpartition("/")[2]
    return name.startswith("image_rect")
