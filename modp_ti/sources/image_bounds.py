"""What an encoded image says of its size, held against its bytes and the memory before a decoder believes it."""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass

from modp_ti.reading.memory import available_memory
from modp_ti.sources.image_header import read_image_header

__all__ = ["MAX_IMAGE_PIXELS", "why_undecodable"]

MAX_IMAGE_PIXELS = 1 << 27
"""Of an image; the largest cameras have about 150 million, and the map works on far fewer."""

# Bytes a pixel while it is decoded: the colours of up to 16 bits a channel, and the copy in the order of ours.
DECODED_BYTES = 12
# Deflate makes 1032 bytes of one at most; JPEG spends a bit at least on a block of 64 pixels, in the channel that has
# the most of them, which is at least a quarter of the image's size.
MOST_INFLATED = 1032
INFLATED_AT_A_TIME = 1 << 18
PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by PNG's kind of colour
MOST_JPEG_PIXELS = 2048  # a byte


@dataclass(frozen=True)
class _Claim:
    """width, height [px]; least: bytes that the file must have for that."""

    width: int
    height: int
    least: int = 0


class _UnknownError(Exception):
    """The header is damaged."""


def why_undecodable(data: bytes) -> str | None:
    """Why a decoder should not be let near these bytes, in words; None where it may be.

    JPEG, PNG, BMP, TIFF, WebP and PNM are let through, with a size that memory and the file's length allow.
    """
    read = next((reader for magic, reader in FORMATS if re.match(magic, data[:16], re.DOTALL)), None)
    if read is None:
        return "it is damaged or no image (JPEG, PNG, BMP, TIFF, WebP, PPM or PGM)"
    try:
        claim = read(data)
    except (_UnknownError, struct.error, IndexError, ValueError):
        return "its header is damaged"
    if claim.width < 1 or claim.height < 1:
        return f"its header says {claim.width}x{claim.height} pixels"
    if claim.width * claim.height > MAX_IMAGE_PIXELS:
        return f"its {claim.width}x{claim.height} pixels are more than {MAX_IMAGE_PIXELS:,}"
    if claim.width * claim.height * DECODED_BYTES > available_memory():
        return f"its {claim.width}x{claim.height} pixels do not fit into this machine's memory"
    if claim.least > len(data):
        return f"the file is cut off: {claim.width}x{claim.height} pixels cannot be in {len(data)} bytes"
    if read is _png and not _inflates(data):
        return "its pixels are damaged or missing"
    return None


def _png(data: bytes) -> _Claim:
    if data[12:16] != b"IHDR":
        raise _UnknownError
    width, height, depth, kind = struct.unpack_from(">IIBB", data, 16)
    channels = PNG_CHANNELS.get(kind, 0)
    if channels == 0 or depth not in (1, 2, 4, 8, 16):
        raise _UnknownError
    return _Claim(width, height, height * (1 + width * channels * depth // 8) // MOST_INFLATED)


def _inflates(data: bytes) -> bool:
    """Whether a PNG's content unpacks to all of its rows. The decoder would find out too, and write to the terminal."""
    width, height, depth, kind, _, _, interlaced = struct.unpack_from(">IIBBBBB", data, 16)
    wanted = 0 if interlaced else height * (1 + (width * PNG_CHANNELS[kind] * depth + 7) // 8)
    inflater, found, at = zlib.decompressobj(), 0, 8
    try:
        while at + 12 <= len(data) and not inflater.eof:
            (length,) = struct.unpack_from(">I", data, at)
            if data[at + 4 : at + 8] == b"IDAT":
                rest = memoryview(data)[at + 8 : at + 8 + length]
                while rest and not inflater.eof:
                    found += len(inflater.decompress(rest, INFLATED_AT_A_TIME))
                    rest = inflater.unconsumed_tail
            at += 12 + length
    except zlib.error:
        return False
    return inflater.eof and found >= wanted


def _jpeg(data: bytes) -> _Claim:
    header = read_image_header(io.BytesIO(data))
    if header is None:
        raise _UnknownError
    return _Claim(header.width, header.height, header.width * header.height // MOST_JPEG_PIXELS)


def _bmp(data: bytes) -> _Claim:
    (size,) = struct.unpack_from("<I", data, 14)
    if size == 12:
        width, height = struct.unpack_from("<HH", data, 18)
        return _Claim(width, height)
    width, height = struct.unpack_from("<ii", data, 18)
    bits, compression = struct.unpack_from("<HI", data, 28)
    plain = compression in (0, 3)
    return _Claim(width, abs(height), abs(height) * max(width, 0) * bits // 8 if plain else 0)


def _pnm(data: bytes) -> _Claim:
    words = re.sub(rb"#[^\n]*\n", b" ", data[:4096]).split(maxsplit=4)
    if len(words) < 4 or max(map(len, words[1:3])) > 9:
        raise _UnknownError
    width, height = int(words[1]), int(words[2])
    kind = int(words[0][1:])
    # A bit or a byte a value, or a digit; text parts its values, but those of bitmaps.
    least = {1: width * height, 2: 2 * width * height, 3: 6 * width * height}.get(
        kind, {4: (width + 7) // 8 * height, 5: width * height, 6: 3 * width * height}.get(kind, 0)
    )
    return _Claim(width, height, least)


def _webp(data: bytes) -> _Claim:
    kind = data[12:16]
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return _Claim(width & 0x3FFF, height & 0x3FFF)
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return _Claim((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1)
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
        return _Claim(width, height)
    raise _UnknownError


TIFF_NUMBERS = {1: "B", 3: "H", 4: "I", 16: "Q"}
TIFF_WIDTH, TIFF_HEIGHT, TIFF_TILE_WIDTH, TIFF_TILE_HEIGHT = 256, 257, 322, 323


def _tiff(data: bytes) -> _Claim:
    """Of the first image in the file. A tile may be larger than the image, and is decoded as a whole."""
    order = "<" if data[:2] == b"II" else ">"
    if struct.unpack_from(order + "H", data, 2)[0] == 42:
        (at,) = struct.unpack_from(order + "I", data, 4)
        (entries,) = struct.unpack_from(order + "H", data, at)
        first, entry, value = at + 2, 12, 8
    else:  # BigTIFF
        (at,) = struct.unpack_from(order + "Q", data, 8)
        if at > len(data):  # beyond 2^63 an offset is none to Python
            raise _UnknownError
        (entries,) = struct.unpack_from(order + "Q", data, at)
        first, entry, value = at + 8, 20, 12
    found: dict[int, int] = {}
    for number in range(min(entries, 4096)):
        tag, kind = struct.unpack_from(order + "HH", data, first + entry * number)
        if TIFF_WIDTH <= tag <= TIFF_TILE_HEIGHT and kind in TIFF_NUMBERS:
            found[tag] = struct.unpack_from(order + TIFF_NUMBERS[kind], data, first + entry * number + value)[0]
    if TIFF_WIDTH not in found or TIFF_HEIGHT not in found:
        raise _UnknownError
    tile = found.get(TIFF_TILE_WIDTH, 1), found.get(TIFF_TILE_HEIGHT, 1)
    return _Claim(*(max(found[side], of) for side, of in zip((TIFF_WIDTH, TIFF_HEIGHT), tile, strict=True)))


FORMATS: tuple[tuple[bytes, Callable[[bytes], _Claim]], ...] = (
    (rb"\x89PNG\r\n\x1a\n", _png),
    (rb"\xff\xd8", _jpeg),
    (rb"BM", _bmp),
    (rb"II\*\0|MM\0\*|II\+\0|MM\0\+", _tiff),
    (rb"RIFF....WEBP", _webp),
    (rb"P[1-6]\s", _pnm),
)
