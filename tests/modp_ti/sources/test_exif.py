"""EXIF focal lengths of JPEG files whose header is written out here, byte by byte."""

from __future__ import annotations

import struct

import pytest

from modp_ti.sources.exif import focal_length_35mm


def jpeg(order: str, entries: list[bytes], inner: list[bytes]) -> bytes:
    """A JPEG header with a TIFF directory of `entries`, its last one a pointer to the directory `inner`."""
    mark = b"II*\0" if order == "<" else b"MM\0*"
    at = 8 + 2 + 12 * (len(entries) + 1) + 4
    directory = struct.pack(order + "H", len(entries) + 1) + b"".join(entries)
    directory += struct.pack(order + "HHII", 0x8769, 4, 1, at) + struct.pack(order + "I", 0)
    directory += struct.pack(order + "H", len(inner)) + b"".join(inner) + struct.pack(order + "I", 0)
    tiff = mark + struct.pack(order + "I", 8) + directory
    app0 = b"\xff\xe0" + struct.pack(">H", 16) + b"JFIF\0" + bytes(9)
    return b"\xff\xd8" + app0 + b"\xff\xe1" + struct.pack(">H", len(tiff) + 8) + b"Exif\0\0" + tiff + b"\xff\xda"


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
        "cut": whole[:60],
        "no_jpeg": b"\x89PNG\r\n\x1a\n" + whole,
        "empty": b"",
    }
    for name, data in cases.items():
        (tmp_path / name).write_bytes(data)
        assert focal_length_35mm(tmp_path / name) is None, name
    assert focal_length_35mm(tmp_path / "absent.jpg") is None
