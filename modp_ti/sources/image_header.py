"""Size and completeness of an image file without decoding it.

Decoders differ in what they do with a file that was cut off (older OpenCV versions fill the rest with grey),
and a run should hear of it in its first second, not at frame 400. JPEG and PNG have end markers and are
checked by them; for other formats the answer is None and the decoder decides.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import BinaryIO

__all__ = ["ImageHeader", "read_image_header"]

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_END = b"IEND\xaeB`\x82"
JPEG_END = b"\xff\xd9"

JPEG_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
JPEG_START_OF_SCAN = 0xDA
# Bytes between two segments, of which writers leave a few at most.
MOST_PADDING = 1 << 16
JPEG_WITHOUT_LENGTH = frozenset([0x01, *range(0xD0, 0xD9)])


@dataclass(frozen=True)
class ImageHeader:
    """What a file's structure tells.

    width, height: stored size in pixels, before any EXIF orientation. complete: the end marker is there.
    """

    width: int
    height: int
    complete: bool


def read_image_header(file: BinaryIO) -> ImageHeader | None:
    """The header of an opened JPEG or PNG file; None for other formats and for files that are neither."""
    signature = file.read(8)
    if signature == PNG_SIGNATURE:
        return _png(file)
    if signature[:2] == b"\xff\xd8":
        file.seek(2)
        return _jpeg(file)
    return None


def _png(file: BinaryIO) -> ImageHeader:
    chunk = file.read(16)
    if len(chunk) < 16 or chunk[4:8] != b"IHDR":
        return ImageHeader(0, 0, complete=False)
    width, height = struct.unpack(">II", chunk[8:16])
    return ImageHeader(width, height, _ends_with(file, PNG_END))


def _jpeg(file: BinaryIO) -> ImageHeader:
    width = height = 0
    while True:
        byte = file.read(1)
        padding = 0  # between segments
        while byte and byte != b"\xff" and padding < MOST_PADDING:
            byte = file.read(1)
            padding += 1
        while byte == b"\xff" and padding < MOST_PADDING:
            byte = file.read(1)
            padding += 1
        if padding >= MOST_PADDING:
            return ImageHeader(width, height, complete=False)
        if not byte:
            return ImageHeader(width, height, complete=False)
        marker = byte[0]
        if marker in JPEG_WITHOUT_LENGTH:
            continue
        raw_length = file.read(2)
        if len(raw_length) < 2:
            return ImageHeader(width, height, complete=False)
        length = struct.unpack(">H", raw_length)[0]
        if marker in JPEG_START_OF_FRAME:
            frame = file.read(5)
            if len(frame) < 5:
                return ImageHeader(0, 0, complete=False)
            height, width = struct.unpack(">HH", frame[1:])
            length -= 5
        file.seek(max(length - 2, 0), 1)
        if marker == JPEG_START_OF_SCAN:
            # Coded data never holds FF D9 except as the end marker, so the first one after the scan's start
            # is it.
            return ImageHeader(width, height, _ends_with(file, JPEG_END))


def _ends_with(file: BinaryIO, marker: bytes) -> bool:
    """Whether the marker closes the file or comes before something appended to it (motion photos)."""
    here = file.tell()
    end = file.seek(0, 2)
    if end - here < len(marker):
        return False
    file.seek(end - len(marker))
    if file.read() == marker:
        return True
    file.seek(here)
    return marker in file.read()
