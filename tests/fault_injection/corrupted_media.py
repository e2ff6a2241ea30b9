"""Corruptions of images, videos, finished runs and camera paths."""

from __future__ import annotations

import struct
from importlib.util import find_spec

from tests.fault_injection.corruptions import (
    HUGE,
    TEXT,
    Corruption,
    appended,
    changed,
    in_json,
    jpeg_of_size,
    patched,
    png_file,
    replaced,
    rows_of,
    setting,
    whole,
    with_line,
)

__all__ = ["IMAGES", "MASK", "PATH", "RUN", "VIDEO"]

IMAGES: dict[str, dict[str, Corruption]] = {
    "images/0.png": {
        "20,000 x 20,000": whole(png_file(20_000, 20_000)),
        "2^31 x 2^31": whole(png_file(2**31 - 1, 2**31 - 1)),
        "0 x 0": whole(png_file(0, 0)),
        "another size": whole(png_file(49, 36, bytes(36 * 148))),
        "pixels missing": whole(png_file(48, 36)),
        "a checksum that is wrong": changed(lambda data: data[:60] + bytes(40) + data[100:]),
        "no end": changed(lambda data: data[:-12]),
        "a chunk of a gigabyte": changed(lambda data: data[:33] + struct.pack(">I", 1 << 30) + b"tEXt" + data[33:]),
        "a GIF in its place": whole(b"GIF89a\xff\xff\xff\xff" + bytes(40)),
    },
    "images/1.jpg": {
        "65,000 x 65,000": jpeg_of_size(65_000, 65_000),
        "0 x 0": jpeg_of_size(0, 0),
        "another size": jpeg_of_size(96, 72),
        "no end": changed(lambda data: data[:-2]),
        "thousands of scans": changed(
            lambda data: data[:-2] + 5000 * data[data.rindex(b"\xff\xda") :][:40] + data[-2:]
        ),
        "a start alone": whole(b"\xff\xd8"),
        "padding alone": whole(b"\xff\xd8" + b"\xff" * 200_000),
    },
    "images/2.bmp": {
        "30,000 x 30,000": patched(18, "<ii", 30_000, 30_000),
        "a negative size": patched(18, "<ii", -48, 36),
        "2^31": patched(18, "<ii", 2**31 - 1, 2**31 - 1),
    },
    "images/3.tiff": {"no directory": patched(4, "<I", 2**32 - 2)},
    "images/4.webp": {"half of it": changed(lambda data: data[: len(data) * 2 // 3])},
    "images/5.ppm": {
        "60,000 x 60,000": changed(lambda data: data.replace(b"48 36", b"60000 60000")),
        "10^20 pixels": changed(lambda data: data.replace(b"48 36", b"99999999999 99999999999")),
        "a negative size": changed(lambda data: data.replace(b"48 36", b"-48 -36")),
        "one row too few": changed(lambda data: data[:-144]),
    },
}


def _ispe(width: int, height: int) -> Corruption:
    """State another size in every box of sizes of HEIC or AVIF."""

    def change(data: bytes) -> bytes:
        *parts, last = data.split(b"ispe")
        start = parts[0] + b"ispe"
        return start + b"ispe".join(
            part[:4] + struct.pack(">II", width, height) + part[12:] for part in (*parts[1:], last)
        )

    return changed(change)


HEIF: dict[str, Corruption] = {
    "60,000 x 60,000": _ispe(60_000, 60_000),
    "0 x 0": _ispe(0, 0),
    "2^32 x 2^32": _ispe(2**32 - 1, 2**32 - 1),
    "no sizes": changed(lambda data: data.replace(b"ispe", b"ispa")),
    "no meta": changed(lambda data: data.replace(b"meta", b"mete")),
    "no primary image": changed(lambda data: data.replace(b"pitm", b"pita")),
    "a first box alone": changed(lambda data: data[:32]),
    "boxes of length 0": changed(lambda data: data[:32] + bytes(200)),
    "a box of 2^63": changed(lambda data: data + b"\0\0\0\1free\x7f" + b"\xff" * 7),
    "no pixels": changed(lambda data: data[: data.index(b"mdat") + 4] + bytes(len(data) - data.index(b"mdat") - 4)),
}
IMAGES["images/6.avif"] = HEIF
if find_spec("pillow_heif") is not None:
    IMAGES["images/7.heic"] = HEIF

MASK: dict[str, dict[str, Corruption]] = {
    "masks/frame-000001.color.png": {
        "another size": whole(png_file(8, 8, bytes(8 * 25))),
        "30,000 x 30,000": whole(png_file(30_000, 30_000)),
    },
    "vignette.png": {
        "black": whole(png_file(48, 36, bytes(36 * 145))),
        "another shape": whole(png_file(8, 36, b"\0" + b"\x7f" * 24 + bytes(35 * 25))),
        "30,000 x 30,000": whole(png_file(30_000, 30_000)),
    },
}

VIDEO: dict[str, Corruption] = {
    "text": whole("a video of a room\n"),
    "an index of 80 million frames": changed(
        lambda data: (
            data[: data.index(b"stsz") + 8] + struct.pack(">II", 500, 80_000_000) + data[data.index(b"stsz") + 16 :]
        )
    ),
    "an edit list of millions": changed(
        lambda data: data[: data.index(b"elst") + 8] + struct.pack(">I", 90_000_000) + data[data.index(b"elst") + 12 :]
    ),
    "no data": changed(lambda data: data[: data.index(b"mdat") + 4] + b"\0" * 64),
    "a box of 2^63": changed(lambda data: data + b"\0\0\0\1mdat\x7f" + b"\xff" * 7),
    "a Matroska start alone": whole(b"\x1aE\xdf\xa3\x9f"),
    "a playlist": whole("#EXTM3U\n#EXTINF:3,\nother.mp4\n"),
    "a list of files": whole("ffconcat version 1.0\nfile other.mp4\n"),
    "an AVI of nothing": whole(b"RIFF\x24\0\0\0AVI " + bytes(32)),
}

RUN: dict[str, dict[str, Corruption]] = {
    "out/splats.ply": {
        "2^60 Gaussians": changed(lambda data: data.replace(b"vertex 40", b"vertex 1152921504606846976")),
        "a negative number": changed(lambda data: data.replace(b"vertex 40", b"vertex -1")),
        "a Gaussian too many": changed(lambda data: data.replace(b"vertex 40", b"vertex 41")),
        "no Gaussian": changed(lambda data: data.replace(b"vertex 40", b"vertex 0")),
        "no opacity": changed(lambda data: data.replace(b"opacity", b"opaqity")),
        "double": changed(lambda data: data.replace(b"float opacity", b"double opacity")),
        "a property without a name": changed(lambda data: data.replace(b"property float nx", b"property float")),
        "five harmonics": changed(lambda data: data.replace(b"float nx", b"float f_rest_0")),
        "ASCII": changed(lambda data: data.replace(b"binary_little_endian", b"ascii")),
        "NaN": patched(-4, "<f", float("nan")),
        "infinity": patched(-28, "<f", float("inf")),
        "a megabyte of comments": changed(lambda data: b"ply\n" + b"comment\n" * 130_000 + data[4:]),
    },
    "out/trajectory.txt": rows_of("0.033333 0.1 0 0 0 0 0 1", 1, 1)
    | {
        "a quaternion of length 0": with_line(1, "0.03 0.1 0 0 0 0 0 0"),
        "a quaternion of 1e20": with_line(1, "0.03 0.1 0 0 0 0 0 1e20"),
        "a pose too many": appended(b"0.5 0 0 0 0 0 0 1\n"),
    },
    "out/frames.json": {
        "a list": whole("[]"),
        "near of 0": in_json(setting("near", 0)),
        "near of infinity": in_json(setting("near", float("inf"))),
        "a depth of NaN": in_json(setting("scene_depth", float("nan"))),
        "a depth of text": in_json(setting("scene_depth", "deep")),
        "a frame that is missing": in_json(setting("keyframes", [0, 99])),
        "a negative frame": in_json(setting("keyframes", [-1])),
        "a keyframe of text": in_json(setting("keyframes", "012")),
        "no keyframes": in_json(setting("keyframes", [])),
        "5000 digits": replaced("0.1", HUGE),
    },
    "out/colmap/images.bin": {
        "2^63 images": patched(0, "<Q", 1 << 63),
        "an unknown camera": patched(68, "<i", 9),
        "a way out of the folder": changed(
            lambda data: data.replace(b"frame-000000.color.png", b"../../../../../../../x")
        ),
    },
    "out/colmap/cameras.bin": {
        "a fisheye": patched(12, "<i", 5),
        "a size of 2^40": patched(16, "<QQ", 1 << 40, 1 << 40),
        "NaN": patched(32, "<d", float("nan")),
    },
}

PATH: dict[str, Corruption] = rows_of("0.033333 0.1 0 0 0 0 0 1", 1, 1) | TEXT
