"""An image's own word on its size is held against its bytes before a decoder believes it."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources import image_bounds
from modp_ti.inputs.sources.image_bounds import why_undecodable

FORMATS = [".png", ".jpg", ".bmp", ".tiff", ".webp", ".ppm", ".pgm"]


def encoded(suffix: str, width: int, height: int, depth: type = np.uint8, channels: int = 3) -> bytes:
    shape = (height, width) if suffix == ".pgm" or channels == 1 else (height, width, channels)
    return cv2.imencode(suffix, np.random.default_rng(5).integers(0, 255, shape).astype(depth))[1].tobytes()


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("size", [(1, 1), (48, 36), (37, 101)])
def test_images_as_they_are_written_are_let_through(suffix: str, size: tuple[int, int], monkeypatch) -> None:
    data = encoded(suffix, *size)
    assert why_undecodable(data) is None
    # The size that is judged is the image's.
    monkeypatch.setattr(image_bounds, "MAX_IMAGE_PIXELS", size[0] * size[1] - 1)
    assert f"its {size[0]}x{size[1]} pixels are more than" in why_undecodable(data)


def test_deep_grey_and_transparent_images_are_let_through() -> None:
    for depth, channels in ((np.uint16, 1), (np.uint16, 3), (np.uint8, 4), (np.uint8, 1)):
        assert why_undecodable(encoded(".png", 31, 17, depth, channels)) is None
    black = np.zeros((1000, 1000, 3), np.uint8)  # which shrinks the most
    for suffix in FORMATS[:-1]:
        assert why_undecodable(cv2.imencode(suffix, black)[1].tobytes()) is None, suffix


def test_an_image_beyond_the_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(image_bounds, "available_memory", lambda: 1000)
    large = encoded(".bmp", 6000, 4000, channels=3)
    assert "do not fit into this machine's memory" in why_undecodable(large)
    with pytest.raises(InputError) as lacking:  # an ordinary image is not to blame
        why_undecodable(encoded(".jpg", 48, 36))
    assert "\n" not in str(lacking.value)


def test_a_chunk_beyond_the_end_is_refused_since_the_decoder_allocates_it() -> None:
    png = encoded(".png", 48, 36)
    at = png.index(b"IDAT") - 4
    longer = png[:at] + struct.pack(">I", 1 << 30) + png[at + 4 :]
    assert why_undecodable(png) is None and why_undecodable(longer) is not None
    assert why_undecodable(png[:-12] + struct.pack(">I", 1 << 30) + b"tEXt" + png[-12:]) is not None


def test_a_jpeg_of_thousands_of_scans_is_refused_and_progressive_ones_are_not() -> None:
    image = np.random.default_rng(5).integers(0, 255, (48, 36, 3), np.uint8)
    progressive = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    scan = progressive.rindex(b"\xff\xda")
    assert why_undecodable(progressive) is None
    assert why_undecodable(progressive[:-2] + 600 * progressive[scan:-2] + b"\xff\xd9") is not None
    # What follows the end, as in motion photos, and metadata count as none.
    appended = progressive + 600 * b"\xff\xda\0\0"
    comment = progressive[:2] + b"\xff\xfe" + struct.pack(">H", 2402) + 600 * b"\xff\xda\0\0" + progressive[2:]
    assert why_undecodable(appended) is None and why_undecodable(comment) is None


def test_a_size_that_the_bytes_cannot_hold_is_refused() -> None:
    png, ppm, bmp, jpg = (encoded(suffix, 48, 36) for suffix in (".png", ".ppm", ".bmp", ".jpg"))
    assert "cannot be in" in why_undecodable(png[:16] + struct.pack(">II", 9000, 9000) + png[24:])
    assert "cannot be in" in why_undecodable(ppm.replace(b"48 36", b"48 37"))
    assert "cannot be in" in why_undecodable(bmp[:18] + struct.pack("<ii", 49, 37) + bmp[26:])
    at = jpg.index(b"\xff\xc0") + 5
    assert "cannot be in" in why_undecodable(jpg[:at] + struct.pack(">HH", 9000, 9000) + jpg[at + 4 :])


def test_a_png_is_looked_through() -> None:
    png = encoded(".png", 48, 36)
    assert why_undecodable(png[:-60] + bytes(40) + png[-20:]) == "its pixels are damaged or missing"
    short = zlib.compress(bytes(35 * 145))
    chunk = struct.pack(">I", len(short)) + b"IDAT" + short + struct.pack(">I", zlib.crc32(b"IDAT" + short))
    assert why_undecodable(png[:33] + chunk + png[-12:]) == "its pixels are damaged or missing"


@pytest.mark.parametrize("data", [b"", b"GIF89a" + bytes(60), b"\0" * 100, b"P7\nWIDTH 4\n", b"RIFF1234WAVEfmt "])
def test_what_is_no_such_image_is_refused(data: bytes) -> None:
    assert why_undecodable(data).startswith("it is damaged or no image")


@pytest.mark.parametrize(
    "data",
    [
        b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR\0\0\0\x30\0\0\0\x24\x08\x02",
        *(b"\x89PNG\r\n\x1a\n", b"BM", b"II*\0\xff\xff\xff\xff", b"RIFF1234WEBPVP8 ", b"P6 x y 255\n"),
        # A TIFF whose width is a ratio, and so no limit's to compare.
        b"II*\0\x08\0\0\0" + struct.pack("<HHHIIHHII", 2, 256, 5, 1, 8, 257, 4, 1, 9) + bytes(4),
        b"II+\0\x08\0\0\0" + b"\xff" * 8,  # a BigTIFF whose directory lies beyond what Python can address
    ],
)
def test_a_header_without_its_rest_is_refused(data: bytes) -> None:
    assert why_undecodable(data) == "its header is damaged"
