"""EXIF focal lengths of JPEG files whose EXIF is written out here, byte by byte."""

from __future__ import annotations

import struct
import tracemalloc

import cv2
import numpy as np
import pytest

from modp_ti.inputs.sources.image_header import focal_length_35mm

CODED = cv2.imencode(".jpg", np.zeros((36, 48, 3), np.uint8))[1].tobytes()


def jpeg(order: str, entries: list[bytes], inner: list[bytes]) -> bytes:
    """A JPEG file with a TIFF directory of `entries`, its last one a pointer to the directory `inner`."""
    mark = b"II*\0" if order == "<" else b"MM\0*"
    at = 8 + 2 + 12 * (len(entries) + 1) + 4
    directory = struct.pack(order + "H", len(entries) + 1) + b"".join(entries)
    directory += struct.pack(order + "HHII", 0x8769, 4, 1, at) + struct.pack(order + "I", 0)
    directory += struct.pack(order + "H", len(inner)) + b"".join(inner) + struct.pack(order + "I", 0)
    tiff = mark + struct.pack(order + "I", 8) + directory
    return with_exif(tiff)


def with_exif(tiff: bytes) -> bytes:
    """In one segment behind the first, or in as many as it takes."""
    rest = b"Exif\0\0" + tiff
    segments = b""
    while rest:
        part, rest = rest[:65_000], rest[65_000:] and b"Exif\0\0" + rest[65_000:]
        segments += b"\xff\xe1" + struct.pack(">H", len(part) + 2) + part
    behind = 4 + int.from_bytes(CODED[4:6], "big")
    return CODED[:behind] + segments + CODED[behind:]


def short(order: str, tag: int, value: int) -> bytes:
    return struct.pack(order + "HHIHH", tag, 3, 1, value, 0)


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_focal_length_is_found_in_both_byte_orders(tmp_path, order):
    file = tmp_path / "photo.jpg"
    file.write_bytes(jpeg(order, [short(order, 0x0112, 6)], [short(order, 0x9207, 5), short(order, 0xA405, 26)]))
    assert focal_length_35mm(file) == 26.0


def test_files_that_do_not_say_it_give_none(tmp_path):
    whole = jpeg("<", [], [short("<", 0xA405, 26)])
    cases = {
        "zero": jpeg("<", [], [short("<", 0xA405, 0)]),
        "other_tags": jpeg("<", [], [short("<", 0x9207, 5)]),
        "two_numbers": jpeg("<", [], [struct.pack("<HHIHH", 0xA405, 3, 2, 26, 26)]),
        "a_ratio": jpeg("<", [], [struct.pack("<HHII", 0xA405, 5, 1, 8)]),
        "text": jpeg("<", [], [struct.pack("<HHI4s", 0xA405, 2, 3, b"26")]),
        "nowhere": with_exif(b"II*\0" + b"\xff" * 8),
        "a_circle": with_exif(b"II*\0\x08\0\0\0" + struct.pack("<HHHII", 1, 0x8769, 4, 1, 8) + bytes(4)),
        "no_tiff": with_exif(b"XX*\0\x08\0\0\0"),
        "no_exif": CODED,
        "cut": whole[:60],
        "no_jpeg": b"\x89PNG\r\n\x1a\n" + whole,
        "empty": b"",
    }
    for name, data in cases.items():
        (tmp_path / name).write_bytes(data)
        assert focal_length_35mm(tmp_path / name) is None, name
    assert focal_length_35mm(tmp_path / "absent.jpg") is None


@pytest.mark.parametrize("size", [65_000, 1 << 19])
def test_tags_that_share_their_bytes_cost_no_memory(tmp_path, size):
    """Pillow alone would unpack each: 84 MiB of 65 kB, 1.8 GiB of half a megabyte (12.3, the last of Python 3.10)."""
    tags = 2700
    start = 8 + 2 + 12 * tags + 4
    entries = b"".join(struct.pack("<HHII", 10_000 + i, 7, size - start, start) for i in range(tags))
    tiff = b"II*\0\x08\0\0\0" + struct.pack("<H", tags) + entries + bytes(4 + size - start)
    file = tmp_path / "a.jpg"
    file.write_bytes(with_exif(tiff))
    tracemalloc.start()
    assert focal_length_35mm(file) is None
    allocated = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert allocated < (16 << 20) + 2 * file.stat().st_size
