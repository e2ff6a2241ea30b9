"""Detection of truncated video files from the lengths stated in the container, without decoding.

Decoders read a truncated file up to its end without an error. MP4 and QuickTime, AVI, and Matroska (WebM) state the
length of each of their parts. Other containers are not supported.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from modp_ti.files import open_file
from modp_ti.files.errors import InputError

__all__ = ["end_of_boxes", "missing_bytes", "require_true_index"]

EBML = b"\x1aE\xdf\xa3"
MATROSKA_SEGMENT = b"\x18S\x80g"
# Largest number of boxes to visit. A recording has a few at its top level, a fragmented one two per second.
MAX_BOXES = 1_000_000
# Further first boxes with which FFmpeg takes a file for one.
RARE_BOXES = (b"styp", b"sidx", b"moof", b"uuid", b"udta", b"trak", b"junk", b"pict", b"prfl", b"hoov", b"meta")
# Boxes that announce the number of frames, of edits, and a packed index. FFmpeg takes them at any depth.
INDEX_BOX = re.compile(b"stsz|stz2|trun|elst|cmov")
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


def require_true_index(file: Path) -> None:
    """Refuse an MP4 or QuickTime file whose index would list more frames than the file has bytes.

    FFmpeg builds the whole index in memory. A few bytes can announce any number of frames of one size, repeat them by
    edit lists (`elst`), or unpack to another index (`cmov`).

    Raises:
        InputError: If it does.
    """
    size = file.stat().st_size
    frames, edits = 0, 1
    with open_file(file) as stream:
        if stream.read(8)[4:] not in (*MP4_BOXES, *RARE_BOXES):
            return
        for start, end, kind in _boxes(stream, size):
            if kind == b"mdat":
                continue
            stream.seek(start)
            content = stream.read(min(end, size) - start)
            for found in INDEX_BOX.finditer(content):
                at = found.end() + (4 if found[0] in (b"trun", b"elst") else 8)
                count = int.from_bytes(content[at : at + 4], "big")
                frames += 0 if found[0] == b"elst" else size + 1 if found[0] == b"cmov" else count
                edits += count if found[0] == b"elst" else 0
    if frames * edits > size:
        raise InputError(f"{file}: its index lists more frames than its {size:,} bytes can hold; the video is damaged")


def end_of_boxes(stream: BinaryIO, size: int) -> int:
    """Return the end of the last box of a file in MP4's structure, as its lengths say.

    A box starts with 4 bytes of length and 4 of type. Length 1 means that 8 bytes of length follow, 0 that the box
    extends to the end of the file.
    """
    return max((end for _, end, _ in _boxes(stream, size)), default=0)


def _boxes(stream: BinaryIO, size: int) -> Iterator[tuple[int, int, bytes]]:
    """Yield start, end and type of the boxes at the top level."""
    here = 0
    for _ in range(MAX_BOXES):
        if here >= size:
            return
        stream.seek(here)
        head = stream.read(16)
        length = int.from_bytes(head[:4], "big")
        if len(head) < 8:
            length = 8
        elif length == 1:
            length = 16 if len(head) < 16 else int.from_bytes(head[8:], "big")
        elif length == 0:
            length = size - here
        start, here = here, here + max(length, 8)
        yield start, here, head[4:8]


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
