"""Image messages as pictures."""

from __future__ import annotations

import io
import re
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.bags.bag import VIDEO
from modp_ti.inputs.sources.image_header import read_image_header, why_undecodable
from modp_ti.inputs.sources.image_pixels import DEPTHS, decoded, reduced

DEPTH_ENCODINGS = ("16UC1", "32FC1")
COMPRESSED = "sensor_msgs/msg/CompressedImage"
# By what the messages of a video may state.
CODECS = {"h264": "h264", "avc": "h264", "h265": "h265", "hevc": "h265"}
# The start of a unit of parameters in the stream of a codec.
PARAMETERS = {"h264": re.compile(rb"\0\0\x01[\x07\x27\x47\x67]"), "h265": re.compile(rb"\0\0\x01[\x40\x42]")}


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
    header = read_image_header(io.BytesIO(message.data.tobytes()))
    return None if header is None or not header.complete or header.width < 1 else (header.width, header.height)


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
        return _uncompressed(message.data.tobytes())
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


def _uncompressed(data: bytes) -> NDArray[np.uint8]:
    reason = "the image is empty" if not data else why_undecodable(data)
    image = decoded(data) if reason is None else None
    if image is None:
        raise ValueError(reason or "it is damaged or no image")
    return image
