"""Whether a video file is all there, from the lengths that its container states, without decoding it.

Decoders play a file that was cut off up to where it ends, and say nothing. MP4 and its kin, AVI, and Matroska (WebM)
state the length of each of their parts; for other containers the answer is None.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from modp_ti.files import open_file

__all__ = ["missing_bytes"]

EBML = b"\x1aE\xdf\xa3"
MATROSKA_SEGMENT = b"\x18S\x80g"
# Boxes that are followed; a recording has a handful at its top, a fragmented one two for each second.
MAX_BOXES = 1_000_000
# What an MP4 or QuickTime file may begin with.
MP4_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot")


def missing_bytes(file: Path) -> int | None:
    """How many bytes the file lacks to what its container states, 0 for a whole one; None where that is not known."""
    size = file.stat().st_size
    with open_file(file) as stream:
        start = stream.read(12)
        if start[4:8] in MP4_BOXES:
            end = _end_of_boxes(stream, size)
        elif start[:4] == b"RIFF" and start[8:] == b"AVI ":
            end = _end_of_riff(stream, size)
        elif start[:4] == EBML:
            end = _end_of_matroska(stream, size)
        else:
            return None
    return None if end is None else max(end - size, 0)


def _end_of_boxes(stream: BinaryIO, size: int) -> int:
    """Where the last box ends: 4 bytes of length, 4 of type, 8 of length where the first is 1; 0 is up to the end."""
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
    """Where the last RIFF chunk ends (files of more than a gigabyte have several): 4 letters, 4 bytes of length."""
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
            return size  # its writer did not come to state it
        end = here + 8 + length
        here = end + length % 2  # padding, which the last one may lack
    return end


def _end_of_matroska(stream: BinaryIO, size: int) -> int | None:
    """Where the segment ends; None where its length is left open, as in a recorded stream."""
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
    """A length of Matroska: as many leading zero bits as further bytes. And whether it is one: all ones means open."""
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
