"""Plausibility check of an encoded image's stated size against its bytes and the memory, before decoding."""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Callable

from PIL import BmpImagePlugin, PpmImagePlugin
from PIL.TiffImagePlugin import IMAGELENGTH, IMAGEWIDTH, TILELENGTH, TILEWIDTH

from modp_ti.files.errors import InputError
from modp_ti.files.reading import available_memory
from modp_ti.inputs.sources.heif import BRANDS, heif_size
from modp_ti.inputs.sources.image_header import HEADER_ERRORS, JpegHeader, bounded, read_tiff_directory

__all__ = ["MAX_IMAGE_PIXELS", "why_undecodable"]

MAX_IMAGE_PIXELS = 1 << 27
"""Largest number of pixels of an image. The largest cameras have about 150 million; the map works on far fewer."""

# Memory per pixel during decoding: up to 16 bits per channel, and the copy in RGB order.
DECODED_BYTES = 12
# Memory of an image that any machine decodes: it is the memory that lacks, not the image that is too large.
ORDINARY = 1 << 28
# Deflate expands a byte to at most 1032. JPEG spends at least one bit on a block of 64 pixels of the largest channel,
# whose size is at least a quarter of the image's.
MOST_INFLATED = 1032
INFLATED_AT_A_TIME = 1 << 18
# Pixels of all scans of a progressive JPEG, which usually has about ten of them, and what a scan counts at least.
MOST_SCANNED, SMALLEST_SCAN, FEW_SCANS = 1 << 31, 1 << 22, 12
# A marker with a length after it, or the end. Coded bytes have 00 or a restart marker (D0 to D7) after FF.
JPEG_MARKER = re.compile(rb"\xff([\xc0-\xcf\xd9-\xfe])")
HEADER_BYTES = 1 << 12  # in which a JPEG 2000 image states its size
PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by PNG colour type
MOST_JPEG_PIXELS = 2048  # per byte
# Smallest number of bits per pixel of the PNM formats: text has a digit and a separator per value, except in bitmaps.
PNM_BITS = {b"1": 8, b"2": 16, b"3": 48, b"4": 1, b"5": 8, b"6": 24}


# Width and height stated in a header [px], and the smallest file size [bytes] that they require.
Claim = tuple[int, int, int]


def why_undecodable(data: bytes) -> str | None:
    """Return why these bytes should not be decoded, or None if they may be.

    Accepted are JPEG, PNG, BMP, TIFF, WebP, PNM, HEIC and AVIF images whose stated size is compatible with the file's
    length and fits into memory.
    """
    read = next((reader for magic, reader in FORMATS if re.match(magic, data[:16], re.DOTALL)), None)
    if read is None:
        return "it is damaged or no image (JPEG, PNG, BMP, TIFF, WebP, PPM, PGM, JPEG 2000, HEIC or AVIF)"
    try:
        width, height, least = read(data)
    except HEADER_ERRORS:
        return "its header is damaged"
    if width < 1 or height < 1:
        return f"its header says {width}x{height} pixels"
    if width * height > MAX_IMAGE_PIXELS:
        return f"its {width}x{height} pixels are more than {MAX_IMAGE_PIXELS:,}"
    needed, left = width * height * DECODED_BYTES, available_memory()
    if needed > left and needed < ORDINARY:
        raise InputError(
            f"an image of {width}x{height} pixels takes {needed >> 20} MB to decode, and this process may have "
            f"{left >> 20} MB more: end other programs, or raise its limit (ulimit -v)"
        )
    if needed > left:
        return f"its {width}x{height} pixels do not fit into this machine's memory"
    if least > len(data):
        return f"the file is cut off: {width}x{height} pixels cannot be in {len(data)} bytes"
    if read is _png and not _inflates(data):
        return "its pixels are damaged or missing"
    if read is _jpeg and (scans := _scans(data)) * max(width * height, SMALLEST_SCAN) > MOST_SCANNED:
        return f"its {width}x{height} pixels are in {scans} scans"
    return None


def _png(data: bytes) -> Claim:
    if data[12:16] != b"IHDR":
        raise ValueError
    width, height, depth, kind, *_ = struct.unpack_from(">IIBBBBB", data, 16)
    channels = PNG_CHANNELS.get(kind, 0)
    if channels == 0 or depth not in (1, 2, 4, 8, 16):
        raise ValueError
    return width, height, height * (1 + width * channels * depth // 8) // MOST_INFLATED


def _inflates(data: bytes) -> bool:
    """Return whether a PNG's data inflates to all of its rows. The decoder would report this to the terminal."""
    width, height, depth, kind, _, _, interlaced = struct.unpack_from(">IIBBBBB", data, 16)
    wanted = 0 if interlaced else height * (1 + (width * PNG_CHANNELS[kind] * depth + 7) // 8)
    inflater, found, at = zlib.decompressobj(), 0, 8
    try:
        while at + 12 <= len(data) and data[at + 4 : at + 8] != b"IEND":
            (length,) = struct.unpack_from(">I", data, at)
            if at + 12 + length > len(data):  # the decoder would allocate it
                return False
            if data[at + 4 : at + 8] == b"IDAT":
                rest = memoryview(data)[at + 8 : at + 8 + length]
                while rest and not inflater.eof:
                    found += len(inflater.decompress(rest, INFLATED_AT_A_TIME))
                    rest = inflater.unconsumed_tail
            at += 12 + length
    except zlib.error:
        return False
    return inflater.eof and found >= wanted


def _jpeg(data: bytes) -> Claim:
    width, height = JpegHeader(bounded(io.BytesIO(data))).size
    return width, height, width * height // MOST_JPEG_PIXELS


def _scans(data: bytes) -> int:
    """Return the number of scans of a JPEG. The decoder goes over all pixels for each, however few bytes it has."""
    scans, at = data.count(b"\xff\xda"), 2
    if scans <= FEW_SCANS:
        return scans
    scans = 0  # count again without what metadata and appended data hold
    while marker := JPEG_MARKER.search(data, at):
        kind, at = marker[1][0], marker.end()
        if kind == 0xD9:  # the end of the image
            break
        scans += kind == 0xDA
        at += int.from_bytes(data[at : at + 2], "big")
    return scans


def _bmp(data: bytes) -> Claim:
    image = BmpImagePlugin.BmpImageFile(bounded(io.BytesIO(data)))
    tile, (width, height) = image.tile[0], image.size
    if tile.codec_name != "raw" or not isinstance(tile.args, tuple):
        return width, height, 0
    return width, height, (height - 1) * int(tile.args[1])  # the last row may lack its padding


def _pnm(data: bytes) -> Claim:
    width, height = PpmImagePlugin.PpmImageFile(bounded(io.BytesIO(data))).size
    return width, height, width * height * PNM_BITS[data[1:2]] // 8


def _webp(data: bytes) -> Claim:
    """Read a WebP header without Pillow, whose reader allocates two canvases of the stated size."""
    kind = data[12:16]
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF, 0
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1, 0
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
        return width, height, 0
    raise ValueError


def _heif(data: bytes) -> Claim:
    return *heif_size(data), 0


def _jp2(data: bytes) -> Claim:
    """Read the size of a JPEG 2000 image from the first box `ihdr`."""
    height, width = struct.unpack_from(">II", data, data.index(b"ihdr", 0, HEADER_BYTES) + 4)
    return width, height, 0


def _tiff(data: bytes) -> Claim:
    """Read the size of the first image in the file. A tile may be larger than the image and is decoded as a whole."""
    found = read_tiff_directory(data)
    sizes = found[IMAGEWIDTH], found[IMAGELENGTH], found.get(TILEWIDTH, 1), found.get(TILELENGTH, 1)
    if not all(isinstance(size, int) for size in sizes):
        raise ValueError
    return max(sizes[::2]), max(sizes[1::2]), 0


FORMATS: tuple[tuple[bytes, Callable[[bytes], Claim]], ...] = (
    (rb"\x89PNG\r\n\x1a\n", _png),
    (rb"\xff\xd8", _jpeg),
    (rb"BM", _bmp),
    (rb"II\*\0|MM\0\*|II\+\0|MM\0\+", _tiff),
    (rb"RIFF....WEBP", _webp),
    (rb"P[1-6]\s", _pnm),
    (rb"\0\0\0\x0cjP  ", _jp2),
    (rb"....ftyp(?:" + b"|".join(BRANDS) + rb")", _heif),
)
