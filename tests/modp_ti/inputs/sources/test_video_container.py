"""A container that was cut off is told by the lengths it states; layouts written out byte by byte."""

from __future__ import annotations

import struct

import pytest

from modp_ti.inputs.sources.video_container import missing_bytes


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", 8 + len(content)) + kind + content


MP4 = box(b"ftyp", b"isom\0\0\0\0") + box(b"moov", bytes(50)) + box(b"mdat", bytes(200))
LARGE_MP4 = box(b"ftyp", b"isom\0\0\0\0") + struct.pack(">I4sQ", 1, b"mdat", 16 + 300) + bytes(300)
AVI = b"RIFF" + struct.pack("<I", 4 + 100) + b"AVI " + bytes(100)
TWO_PART_AVI = AVI + b"RIFF" + struct.pack("<I", 4 + 60) + b"AVIX" + bytes(60)
# EBML header of 4 bytes; a segment whose length takes one byte (0x80 | 90), or two (0x4000 | 300)
MATROSKA = b"\x1aE\xdf\xa3\x84abcd\x18S\x80g" + bytes([0x80 | 90]) + bytes(90)
LONGER_MATROSKA = b"\x1aE\xdf\xa3\x84abcd\x18S\x80g" + (0x4000 | 300).to_bytes(2, "big") + bytes(300)
WHOLE = {
    "mp4": MP4,
    "mp4 beyond 4 GB": LARGE_MP4,
    "avi": AVI,
    "avi in two parts": TWO_PART_AVI,
    "mkv": MATROSKA,
    "webm": LONGER_MATROSKA,
}


@pytest.mark.parametrize("data", WHOLE.values(), ids=WHOLE)
@pytest.mark.parametrize("lost", [0, 1, 17, 55])
def test_lost_bytes_are_counted(tmp_path, data, lost):
    file = tmp_path / "video"
    file.write_bytes(data[: len(data) - lost])
    assert missing_bytes(file) == lost


@pytest.mark.parametrize(
    "data",
    [
        box(b"ftyp", b"isom\0\0\0\0") + struct.pack(">I", 0) + b"mdat" + bytes(33),  # length 0: up to the end
        AVI + b"ID3 appended",
        b"RIFF" + struct.pack("<I", 4 + 99) + b"AVI " + bytes(99),  # odd, and without its padding
    ],
)
def test_open_ends_and_appended_bytes_are_no_loss(tmp_path, data):
    file = tmp_path / "video"
    file.write_bytes(data)
    assert missing_bytes(file) == 0


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"no video",
        b"G" + bytes(187),  # MPEG-TS has no length
        b"\x1aE\xdf\xa3\x84abcd\x18S\x80g\x01" + b"\xff" * 7 + bytes(20),  # a recorded stream's segment, left open
    ],
)
def test_containers_without_a_length_are_not_judged(tmp_path, data):
    file = tmp_path / "video"
    file.write_bytes(data)
    assert missing_bytes(file) is None
