"""Detection of truncated video files from the lengths stated in the container, without decoding.

Decoders read a truncated file up to its end without an error. MP4 and QuickTime, AVI, and Matroska (WebM) state the
length of each of their parts. Other containers are not supported.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from modp_ti.files import open_file

__all__ = ["end_of_boxes", "missing_bytes"]

EBML = b"\x1aE\xdf\xa3"
MATROSKA_SEGMENT = b"\x18S\x80g"
# Largest number of boxes to visit. A recording has a few at its top level, a fragmented one two per second.
MAX_BOXES = 1_000_000
# Types of the first box of an MP4 or QuickTime file.
MP4_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot")


def missing_bytes(file: Path) -> int | None:
    """Return how many bytes a video file lacks according to its container.

    Args:
        file: The video file.

    Returns:
        The number of missing bytes, 0 for a complete file, or None if the container does not tell.
    """
    size = file.stat().st_size
    with open_file(file) as stream:
        start = stream.read(12)
        if start[4:8] in MP4_BOXES:
            end = end_of_boxes(stream, size)
        elif start[:4] == b"RIFF" and start[8:] == b"AVI ":
            end = _end_of_riff(stream, size)
        elif start[:4] == EBML:
            end = _end_of_matroska(stream, size)
        else:
            return None
    return None if end is None else max(end - size, 0)


def end_of_boxes(stream: BinaryIO, size: int) -> int:
    """Return the end of the last box of a file in MP4's structure, as its lengths say.

    A box starts with 4 bytes of length and 4 of type. Length 1 means that 8 bytes of length follow, 0 that the box
    extends to the end of the file.
    """
    here = 0
    for _ in range(MAX_BOXES):
        if here >= size:
            break
        stream.seek(here)
        head = stream.read(16)
        length = int.from_bytes(head[:4], "big")
        if len(head) < 8:
            return here + 8
        if length == 1:
            if len(head) < 16:
                return here + 16
            length = int.from_bytes(head[8:], "big")
        if length == 0:
            return size
        here += max(length, 8)
    return here


def _end_of_riff(stream: BinaryIO, size: int) -> int:
    """Return the end of the last RIFF chunk. Files of more than a gigabyte have several.

    A chunk starts with 4 letters and 4 bytes of length.
    """
    here = end = 0
    while here < size:
        stream.seek(here)
        head = stream.read(8)
        if here and head[:4] != b"RIFF":
            return end  # something was appended
        length = int.from_bytes(head[4:], "little")
        if len(head) < 8:
            return here + 8
        if length == 0:
            return size  # the writer was interrupted before it stored the length
        end = here + 8 + length
        here = end + length % 2  # padding, which the last chunk may lack
    return end


def _end_of_matroska(stream: BinaryIO, size: int) -> int | None:
    """Return the end of the segment, or None if its length is unknown, as in a recorded stream."""
    stream.seek(len(EBML))
    header, _ = _variable_length(stream)
    if header is None:
        return None
    if header > size:
        return stream.tell() + header
    stream.seek(header, 1)
    if stream.read(4) != MATROSKA_SEGMENT:
        return size + 1 if stream.tell() >= size else None
    length, known = _variable_length(stream)
    return None if length is None or not known else stream.tell() + length


def _variable_length(stream: BinaryIO) -> tuple[int | None, bool]:
    """Read a Matroska length: the number of leading zero bits is the number of further bytes.

    Returns the length, or None if it is invalid, and whether it is known: all ones means unknown.
    """
    first = stream.read(1)
    if not first or first[0] == 0:
        return None, False
    further = 8 - first[0].bit_length()
    rest = stream.read(further)
    if len(rest) < further:
        return None, False
    bits = 7 * (further + 1)
    value = int.from_bytes(first + rest, "big") & ((1 << bits) - 1)
    return value, value != (1 << bits) - 1
