"""Size and completeness of an image file without decoding it, with Pillow in bounded memory.

Decoders differ in what they do with a truncated file (older OpenCV versions fill the rest with grey), and a run should
report it in its first second, not at frame 400. JPEG and PNG files are checked by their end markers, HEIC and AVIF
files by the lengths of their boxes; other formats are left to the decoder. EXIF orientation, colour profile and alpha
channel of PNG, WebP and TIFF files are found here too.

Pillow keeps everything that it reads from a header, and thousands of TIFF or EXIF tags can refer to the same bytes:
Pillow 12.3 allocates 1.8 GB for half a megabyte. Therefore it reads through a `bounded` file.
"""

from __future__ import annotations

import io
import re
import struct
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, BinaryIO

import numpy as np
from PIL import ExifTags, ImageFile, JpegImagePlugin, PngImagePlugin, TiffImagePlugin, WebPImagePlugin

from modp_ti.files import open_file
from modp_ti.inputs.sources.heif import is_heif, read_heif_header
from modp_ti.inputs.sources.video_container import end_of_boxes

__all__ = [
    "HEADER_ERRORS",
    "ImageHeader",
    "JpegHeader",
    "bounded",
    "focal_length_35mm",
    "read_image_header",
    "read_tiff_directory",
]

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_END = b"IEND\xaeB`\x82"
JPEG_SIGNATURE = b"\xff\xd8"
JPEG_END = b"\xff\xd9"
TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
GPANO = re.compile(rb"ProjectionType\s*(?:=\s*[\"']|>)\s*equirectangular")
# A header may read HEADER_BYTES plus half of the file. Each call counts as CALL_BYTES in addition.
HEADER_BYTES, CALL_BYTES = 1 << 23, 1 << 7

HEADER_ERRORS = (SyntaxError, OSError, LookupError, TypeError, ValueError, ArithmeticError, struct.error)
"""Exceptions that Pillow raises for malformed headers."""

# Pillow warns of malformed tags. The filter is global because `warnings.catch_warnings` is not safe with threads.
warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.TiffImagePlugin")


@dataclass(frozen=True)
class ImageHeader:
    """Size, orientation, depth and completeness of an image file.

    Attributes:
        width: Width [px] of the decoded image, before any EXIF rotation; 0 if the header is damaged.
        height: Height [px], likewise.
        complete: Whether the end of the file is there; None if only the decoder finds out.
        orientation: EXIF orientation, 1 to 8, which is left to apply; 1 if the file states none.
        bits: Bits per channel.
        alpha: Whether a PNG, WebP or TIFF file has an alpha channel.
        grey: Whether a PNG or TIFF file has one channel.
        profile: ICC profile of the colours; empty without.
        panorama: Whether GPano in a JPEG file says that the image is equirectangular.
        is_tiff: Whether it is a TIFF file, which OpenCV turns upright by itself.
    """

    width: int
    height: int
    complete: bool | None
    orientation: int = 1
    bits: int = 8
    alpha: bool = False
    grey: bool = False
    profile: bytes = b""
    panorama: bool = False
    is_tiff: bool = False


class _Bounded(io.BufferedIOBase):
    """A file object that raises OSError once more data has been read than a valid header needs."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        here = file.tell()
        self._left = HEADER_BYTES + file.seek(0, 2) // 2
        file.seek(here)

    def read(self, size: int | None = -1) -> bytes:
        data = self._file.read(-1 if size is None else size)
        self._left -= len(data) + CALL_BYTES
        if self._left < 0:
            raise OSError("the header is too long")
        return data

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()


def bounded(file: BinaryIO) -> IO[bytes]:
    """Wrap a file so that reading more than a valid header needs raises OSError."""
    # Pillow reads, seeks and tells only, but its stubs require every method of IO.
    return _Bounded(file)  # pyright: ignore[reportReturnType]


class JpegHeader(JpegImagePlugin.JpegImageFile):
    """Pillow's JPEG reader. After construction the file is positioned at the first coded byte.

    Raises `HEADER_ERRORS` for malformed headers.
    """

    def _read_dpi_from_exif(self) -> None:
        """Disabled, because Pillow would unpack all of EXIF here, which costs memory."""


def read_image_header(file: BinaryIO) -> ImageHeader | None:
    """Read the header of an open JPEG, PNG, WebP, TIFF, HEIC or AVIF file. Returns None for all other files.

    Raises:
        InputError: If the package that reads HEIC or AVIF is missing.
    """
    signature = file.read(12)
    if is_heif(signature):
        return _heif_header(file)
    if signature.startswith(PNG_SIGNATURE):
        return _png_header(file)
    if signature[:4] == b"RIFF" and signature[8:] == b"WEBP":
        return _header_by_pillow(file, WebPImagePlugin.WebPImageFile)
    if signature[:4] in TIFF_SIGNATURES:
        return _header_by_pillow(file, TiffImagePlugin.TiffImageFile)
    if signature[:2] != JPEG_SIGNATURE:
        return None
    file.seek(0)
    try:
        header = JpegHeader(bounded(file))
    except HEADER_ERRORS:
        file.seek(-min(2, file.seek(0, 2)), 2)
        return ImageHeader(0, 0, complete=file.read() == JPEG_END)
    # Coded data never holds FF D9 except as the end marker, so the first one after the scan's start is it.
    complete = _ends_with(file, JPEG_END)
    profile, xmp = header.info.get("icc_profile") or b"", header.info.get("xmp") or b""
    return ImageHeader(*header.size, complete, _orientation(header), profile=profile, panorama=bool(GPANO.search(xmp)))


def _heif_header(file: BinaryIO) -> ImageHeader:
    file.seek(0)
    data = file.read()
    header = read_heif_header(data)
    complete = end_of_boxes(file, len(data)) <= len(data)
    if header is None:
        return ImageHeader(0, 0, complete)
    return ImageHeader(header.width, header.height, complete, header.orientation, profile=header.profile)


def _png_header(file: BinaryIO) -> ImageHeader:
    # The size is at a fixed offset.
    file.seek(8)
    chunk = file.read(17)
    if len(chunk) < 17 or chunk[4:8] != b"IHDR":
        return ImageHeader(0, 0, complete=False)
    width, height = struct.unpack(">II", chunk[8:16])
    header = ImageHeader(width, height, _ends_with(file, PNG_END), bits=chunk[16])
    more = _header_by_pillow(file, PngImagePlugin.PngImageFile)
    return header if more is None else replace(more, complete=header.complete, bits=header.bits)


def _header_by_pillow(file: BinaryIO, form: type[ImageFile.ImageFile]) -> ImageHeader | None:
    """Read the header of a PNG, WebP or TIFF file with Pillow; None if it is damaged, or has a form unknown to it."""
    file.seek(0)
    try:
        image = form(bounded(file))
        tags = image.tag_v2 if isinstance(image, TiffImagePlugin.TiffImageFile) else {}
        orientation = tags.get(ExifTags.Base.Orientation, 1)
        if not tags:
            orientation = _exif_orientation(image.info.get("exif", b"").removeprefix(b"Exif\0\0"))
        size = (TiffImagePlugin.IMAGEWIDTH, TiffImagePlugin.IMAGELENGTH)  # Pillow states that of the upright image
        return ImageHeader(
            *([int(tags[tag]) for tag in size] if tags else image.size),
            complete=None,
            orientation=orientation,
            bits=int(np.max(tags.get(TiffImagePlugin.BITSPERSAMPLE, 8))),
            alpha=image.has_transparency_data,
            grey=len(image.getbands()) == 1 and image.mode != "P",
            profile=image.info.get("icc_profile") or b"",
            is_tiff=bool(tags),
        )
    except (*HEADER_ERRORS, EOFError, RuntimeError, MemoryError):
        return None


def read_tiff_directory(data: bytes, offset: int | None = None) -> TiffImagePlugin.ImageFileDirectory_v2:
    """Read the tags of a directory in a TIFF structure. Raises `HEADER_ERRORS` for malformed data.

    Args:
        data: The TIFF structure.
        offset: Offset of the directory [bytes]; the first directory if None.

    Returns:
        The tags. If the directory is damaged or too large, only those before that position.
    """
    file = bounded(io.BytesIO(data))
    # The byte order is passed separately: Pillow recognises BigTIFF in little-endian order only.
    start = b"II+\0" + data[4:16] if data[2:4] in (b"+\0", b"\0+") else b"II*\0" + data[4:8]
    directory = TiffImagePlugin.ImageFileDirectory_v2(start, prefix=data[:2])
    file.seek(directory.next if offset is None else offset)
    directory.load(file)
    return directory


def _orientation(header: JpegHeader) -> int:
    """Return the EXIF orientation that a JPEG file states, or 1."""
    try:
        return _exif_orientation(_tiff(header))
    except HEADER_ERRORS:
        return 1


def _exif_orientation(tiff: bytes) -> int:
    """Return the orientation in the TIFF structure of EXIF, or 1."""
    if tiff[:4] not in TIFF_SIGNATURES:
        return 1
    try:
        value = read_tiff_directory(tiff)[ExifTags.Base.Orientation]
    except HEADER_ERRORS:
        return 1
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def _tiff(header: JpegHeader) -> bytes:
    """Return the TIFF structure of a JPEG file's EXIF. Raises `HEADER_ERRORS` if there is none."""
    return header.info["exif"].removeprefix(b"Exif\0\0")


def _ends_with(file: BinaryIO, marker: bytes) -> bool:
    """Return whether the marker ends the file, or precedes data appended to it, as in motion photos."""
    here = file.tell()
    file.seek(max(here, file.seek(0, 2) - len(marker)))
    if file.read() == marker:
        return True
    file.seek(here)
    return marker in file.read()


def focal_length_35mm(path: Path) -> float | None:
    """Read the focal length in 35 mm equivalent [mm] from a JPEG, HEIC or AVIF file; None if it is not stated.

    Raises:
        InputError: If the package that reads HEIC or AVIF is missing.
    """
    try:
        with open_file(path) as file:
            heif = is_heif(file.read(12))
            file.seek(0)
            if heif:
                header = read_heif_header(file.read())
                tiff = b"" if header is None else header.tiff
            else:
                tiff = _tiff(JpegHeader(bounded(file)))
        inner = read_tiff_directory(tiff)[ExifTags.IFD.Exif]
        value = read_tiff_directory(tiff, inner)[ExifTags.Base.FocalLengthIn35mmFilm]
    except HEADER_ERRORS:  # also raised if EXIF or the tag is missing
        return None
    return float(value) if isinstance(value, int) and value > 0 else None
