"""Bounded unpacking of what bags hold packed. `rosbags` by itself unpacks without a bound."""

from __future__ import annotations

import bz2
import sys
from typing import Any

from modp_ti.files.reading import most_unpacked

MAX_RATIO = 100  # of a chunk, which may hold dark images
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def is_packed(raw: bytes) -> bool:
    """Whether a message of ROS 2 is packed. Those that are not begin with a zero byte."""
    return raw.startswith(ZSTD_MAGIC)


def unpacked(raw: bytes) -> bytes:
    """Unpack a message of ROS 2. Raises ValueError if it is damaged or becomes too large."""
    return _bounded(_zstd().ZstdDecompressor(), raw)


def limit_unpacking() -> None:
    """Replace the functions by which `rosbags` unpacks chunks by bounded ones, for this process."""
    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1.reader import decompressors
    from rosbags.rosbag2.storage_mcap import DECOMPRESSORS

    decompressors["bz2"] = lambda data: _bounded(bz2.BZ2Decompressor(), data)
    decompressors["lz4"] = lambda data: _bounded(LZ4FrameDecompressor(), data)
    DECOMPRESSORS["lz4"] = lambda data, _: _bounded(LZ4FrameDecompressor(), data)
    DECOMPRESSORS["zstd"] = lambda data, _: unpacked(data)


def _bounded(decompressor: Any, data: bytes) -> bytes:
    result = decompressor.decompress(data, most_unpacked(len(data), MAX_RATIO))
    if not decompressor.eof:
        raise ValueError(f"a chunk is cut off, or unpacks to more than {len(result)} bytes")
    return result


def _zstd() -> Any:
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd
