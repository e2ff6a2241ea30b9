"""What a photograph's EXIF header says of the lens."""

from __future__ import annotations

import struct
from pathlib import Path

from modp_ti.reading import open_file

__all__ = ["focal_length_35mm"]

EXIF_IFD = 0x8769
FOCAL_LENGTH_35MM = 0xA405
SHORT, LONG = 3, 4
LONGEST_HEADER = 1 << 17


def focal_length_35mm(path: Path) -> float | None:
    """Focal length [mm] that a camera of 24x36 mm film would need for the same view; None where the file says nothing.

    JPEG files only.
    """
    try:
        with open_file(path) as file:
            data = file.read(LONGEST_HEADER)
    except OSError:
        return None
    tiff = _exif_segment(data)
    if tiff is None:
        return None
    try:
        value = _focal_length(tiff)
    except (struct.error, IndexError):  # cut off, or no EXIF after all
        return None
    return float(value) if value else None


def _exif_segment(data: bytes) -> bytes | None:
    """The TIFF structure in a JPEG file's APP1 segment."""
    if data[:2] != b"\xff\xd8":
        return None
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        (length,) = struct.unpack(">H", data[at + 2 : at + 4])
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            return data[at + 10 : at + 2 + length]
        at += 2 + length
    return None


def _focal_length(tiff: bytes) -> int | None:
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return None
    (first,) = struct.unpack_from(order + "I", tiff, 4)
    inner = _entry(tiff, order, first, EXIF_IFD)
    return None if inner is None else _entry(tiff, order, inner, FOCAL_LENGTH_35MM)


def _entry(tiff: bytes, order: str, offset: int, wanted: int) -> int | None:
    """Value of a whole-number tag in the directory at `offset`."""
    (count,) = struct.unpack_from(order + "H", tiff, offset)
    for i in range(count):
        tag, kind, number = struct.unpack_from(order + "HHI", tiff, offset + 2 + 12 * i)
        if tag == wanted and number == 1 and kind in (SHORT, LONG):
            return struct.unpack_from(order + ("H" if kind == SHORT else "I"), tiff, offset + 10 + 12 * i)[0]
    return None
