"""What an image file says about itself, read with Pillow without decoding its pixels, and whether it may be decoded.

Decoders differ in what they do with a truncated file (older OpenCV versions fill the rest with grey), and a run should
report it in its first second, not at frame 400. JPEG and PNG files are checked by their end markers, HEIC and AVIF
files by the lengths of their boxes; other formats are left to the decoder.
"""

from __future__ import annotations

import io
import re
import struct
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from PIL import ExifTags, Image, JpegImagePlugin, TiffImagePlugin

from modp_ti.files import open_file
from modp_ti.files.errors import InputError
from modp_ti.files.reading import available_memory

MAX_IMAGE_PIXELS = 1 << 27
"""Largest number of pixels of an image. The largest cameras have about 150 million; the map works on far fewer."""

# Memory per pixel during decoding: up to 16 bits per channel, and the copy in RGB order.
DECODED_BYTES = 12
PNG_SIGNATURE, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
JPEG_SIGNATURE, JPEG_END = b"\xff\xd8", b"\xff\xd9"
TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# What the first box of a HEIC or AVIF file may name first.
BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"mif2", b"msf1", b"miaf", b"avif", b"avis")
FORMATS = ("JPEG", "PNG", "BMP", "TIFF", "WEBP", "PPM", "JPEG2000")
GPANO = re.compile(rb"ProjectionType\s*(?:=\s*[\"']|>)\s*equirectangular")

HEADER_ERRORS = (
    *(SyntaxError, OSError, LookupError, TypeError, ValueError, ArithmeticError, RuntimeError, EOFError, struct.error),
    *(MemoryError, Image.DecompressionBombError),
)
"""Exceptions that Pillow raises for malformed files."""

# Pillow warns of malformed tags. The filter is global because `warnings.catch_warnings` is not safe with threads.
warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.TiffImagePlugin")


class DamagedImageError(OSError, ValueError):
    """An image cannot be decoded, or should not be. The text says why, in words for within a message."""


@dataclass(frozen=True)
class ImageHeader:
    """Size, orientation and depth of an image file whose end is there, as far as that can be told without decoding it.

    Attributes:
        width: Width [px] of the decoded image, before any EXIF rotation.
        height: Height [px], likewise.
        complete: Whether the end of the file is there; False if only the decoder finds out.
        orientation: EXIF orientation, 1 to 8, which is left to apply; 1 if the file states none.
        bits: Bits per channel; 16 if only the decoder finds out.
        alpha: Whether a PNG, WebP or TIFF file has an alpha channel.
        grey: Whether a PNG or TIFF file has one channel.
        profile: ICC profile of the colours; empty without.
        panorama: Whether GPano says that the image is equirectangular.
        is_tiff: Whether it is a TIFF file, which OpenCV turns upright by itself.
    """

    width: int
    height: int
    complete: bool
    orientation: int = 1
    bits: int = 8
    alpha: bool = False
    grey: bool = False
    profile: bytes = b""
    panorama: bool = False
    is_tiff: bool = False


def heif_kind(start: bytes) -> str | None:
    """Return "AVIF" or "HEIF" for a file that starts with these bytes (64 or more), or None if it is neither."""
    if start[4:8] != b"ftyp" or start[8:12] not in BRANDS:
        return None
    first = start[8 : int.from_bytes(start[:4], "big")]
    return "AVIF" if b"avif" in first or b"avis" in first else "HEIF"


def read_image_header(file: BinaryIO) -> ImageHeader:
    """Read the header of an open JPEG, PNG, BMP, TIFF, WebP, PNM, JPEG 2000, HEIC or AVIF file.

    Raises:
        DamagedImageError: If it is none, or is cut off.
        InputError: If the package that reads HEIC or AVIF is missing.
    """
    start = file.read(64)
    file.seek(0)
    is_jpeg, is_png, is_tiff = start[:2] == JPEG_SIGNATURE, start[:8] == PNG_SIGNATURE, start[:4] in TIFF_SIGNATURES
    try:
        # As a class, which leaves the file at the first coded byte.
        image = JpegImagePlugin.JpegImageFile(file) if is_jpeg else open_image(file)
        complete = _is_complete(file, start)
        tags = image.tag_v2 if isinstance(image, TiffImagePlugin.TiffImageFile) else {}
        size = (TiffImagePlugin.IMAGEWIDTH, TiffImagePlugin.IMAGELENGTH)  # Pillow states that of the upright image
        bits = int(np.max(tags.get(TiffImagePlugin.BITSPERSAMPLE, 8)))
        header = ImageHeader(
            *([int(tags[tag]) for tag in size] if is_tiff else image.size),
            complete=complete is True,
            orientation=_orientation(image),
            bits=start[24] if is_png else 16 if image.format in ("PPM", "JPEG2000") else bits,
            alpha=image.format in ("PNG", "WEBP", "TIFF") and image.has_transparency_data,
            grey=(is_png or is_tiff) and len(image.getbands()) == 1 and image.mode != "P",
            profile=image.info.get("icc_profile") or b"",
            panorama=bool(GPANO.search(image.info.get("xmp") or b"")),
            is_tiff=is_tiff,
        )
    except Image.DecompressionBombError:
        raise DamagedImageError(f"its pixels are more than {MAX_IMAGE_PIXELS:,}") from None
    except HEADER_ERRORS:
        raise DamagedImageError(
            "it is damaged or no image (JPEG, PNG, BMP, TIFF of up to 16 bits, WebP, PPM, PGM, JPEG 2000, HEIC or AVIF)"
        ) from None
    if complete is False:
        raise DamagedImageError("the file is cut off")
    return header


def decodable(data: bytes) -> ImageHeader:
    """Return the header of an image file's content that may be decoded.

    Raises:
        DamagedImageError: As `read_image_header`, if it has more than `MAX_IMAGE_PIXELS` pixels, or if there is too
            little memory for them.
        InputError: As `read_image_header`.
    """
    header = read_image_header(io.BytesIO(data))
    size, pixels = f"its {header.width}x{header.height} pixels", header.width * header.height
    if pixels > MAX_IMAGE_PIXELS:
        raise DamagedImageError(f"{size} are more than {MAX_IMAGE_PIXELS:,}")
    needed, left = pixels * DECODED_BYTES, available_memory()
    if needed > left:
        raise DamagedImageError(f"{size} take {needed >> 20} MB, and {left >> 20} MB are free: end other programs")
    return header


def open_image(file: BinaryIO) -> Image.Image:
    """Open an image file with Pillow, without decoding it.

    Raises:
        InputError: If the package that reads HEIC or AVIF is missing. For other faults, one of `HEADER_ERRORS`.
    """
    kind = heif_kind(file.read(64))
    file.seek(0)
    if kind is None:
        return Image.open(file, formats=FORMATS)
    try:
        if kind == "AVIF":
            from PIL import AvifImagePlugin  # noqa: F401 - whether there is one
        else:
            from pillow_heif import register_heif_opener

            register_heif_opener()
    except ImportError:
        package = "'pillow>=11.3'" if kind == "AVIF" else "'modp-ti[heic]'"
        raise InputError(f"{kind} photographs need a package: pip install {package}") from None
    return Image.open(file, formats=[kind])


def _orientation(image: Image.Image) -> int:
    """Return the EXIF orientation that is left to apply, or 1. The decoder of HEIC applies it."""
    if image.format == "HEIF":
        return 1
    try:
        value = image.getexif().get(ExifTags.Base.Orientation)
    except HEADER_ERRORS:
        return 1
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def _is_complete(file: BinaryIO, start: bytes) -> bool | None:
    """Return whether the end of a file is there, from the file's position on; None if only the decoder finds out."""
    if heif_kind(start) is not None:
        return _boxes_are_whole(file)
    # Coded data never holds FF D9 except as the end marker, so the first one after the scan's start is it.
    marker = JPEG_END if start[:2] == JPEG_SIGNATURE else PNG_END if start[:8] == PNG_SIGNATURE else None
    if marker is None:
        return None
    here = file.tell()
    file.seek(max(here, file.seek(0, 2) - len(marker)))
    if file.read() == marker:
        return True
    file.seek(here)
    return marker in file.read()  # data may be appended, as in motion photos


def _boxes_are_whole(file: BinaryIO) -> bool:
    """Return whether the boxes of a file end within it.

    A box starts with 4 bytes of length and 4 of type. Length 1 means that 8 bytes of length follow, 0 that the box
    extends to the end.
    """
    size, at = file.seek(0, 2), 0
    while at < size:
        file.seek(at)
        head = file.read(16)
        length = int.from_bytes(head[:4], "big")
        if length == 0:
            return len(head) >= 8
        at += max(int.from_bytes(head[8:], "big") if length == 1 else length, 8)
    return at == size


def focal_length_35mm(path: Path) -> float | None:
    """Read the focal length in 35 mm equivalent [mm] from an image file's EXIF; None if it is not stated.

    Raises:
        InputError: If the package that reads HEIC or AVIF is missing.
    """
    value = _tags(path, ExifTags.IFD.Exif).get(ExifTags.Base.FocalLengthIn35mmFilm)
    return float(value) if isinstance(value, int) and value > 0 else None


def photo_position(path: Path) -> tuple[float, float, float] | None:
    """Read latitude, longitude [degrees] and height [m] from an image file's EXIF; None if they are not all stated.

    Raises:
        InputError: As `focal_length_35mm`.
    """
    tags, GPS = _tags(path, ExifTags.IFD.GPSInfo), ExifTags.GPS
    try:
        degrees = [
            sum(float(part) / 60**n for n, part in enumerate(tags[angle]))
            for angle in (GPS.GPSLatitude, GPS.GPSLongitude)
        ]
        south, west = tags.get(GPS.GPSLatitudeRef) == "S", tags.get(GPS.GPSLongitudeRef) == "W"
        below = tags.get(GPS.GPSAltitudeRef) in (1, b"\1")
        found = (-degrees[0] if south else degrees[0], -degrees[1] if west else degrees[1])
        height = float(tags[GPS.GPSAltitude])
        return (*found, -height if below else height) if np.isfinite([*found, height]).all() else None
    except HEADER_ERRORS:
        return None


def _tags(path: Path, part: ExifTags.IFD) -> dict[int, Any]:
    """Return the tags of a part of an image file's EXIF, none if it has none."""
    try:
        with open_file(path) as file:
            return open_image(file).getexif().get_ifd(part)
    except HEADER_ERRORS:
        return {}
