"""A container that was cut off is told by the lengths it states; layouts written out byte by byte."""

from __future__ import annotations

import struct

import pytest

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.video_container import missing_bytes, require_true_index


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


def index(*boxes: tuple[bytes, int], first: bytes = b"ftyp", samples: int = 5000) -> bytes:
    """An MP4 of `samples` bytes whose index has these boxes, each with its count."""
    content = b"".join(
        mp4_box(kind, bytes(4 if kind in (b"trun", b"elst") else 8) + struct.pack(">I", n)) for kind, n in boxes
    )
    place = b"moof" if boxes[0][0] == b"trun" else b"moov"
    return (
        mp4_box(first, bytes(8))
        + mp4_box(place, mp4_box(b"trak", content))
        + mp4_box(b"mdat", b"stsz" + b"\xff" * samples)
    )


def mp4_box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content) + 8) + kind + content


@pytest.mark.parametrize(
    "boxes",
    [
        [(b"stsz", 80_000_000)],
        [(b"stsz", 3000), (b"stsz", 3000)],
        [(b"stz2", 80_000_000)],
        [(b"trun", 80_000_000)],
        [(b"stsz", 100), (b"elst", 10_000)],
        [(b"cmov", 0)],
    ],
)
@pytest.mark.parametrize("first", [b"ftyp", b"styp"])
def test_an_index_of_more_frames_than_bytes_is_refused(tmp_path, boxes, first):
    (tmp_path / "a.mp4").write_bytes(index(*boxes, first=first))
    with pytest.raises(InputError):
        require_true_index(tmp_path / "a.mp4")


def test_an_index_of_frames_that_are_there_is_taken(tmp_path):
    for data in (
        index((b"stsz", 4000), (b"elst", 0)),
        index((b"trun", 4000)),
        index((b"stsz", 100), (b"elst", 3)),
        b"RIFF",
    ):
        (tmp_path / "a.mp4").write_bytes(data)
        require_true_index(tmp_path / "a.mp4")
