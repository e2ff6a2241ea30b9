"""Size and completeness of an image file without decoding it, with Pillow in bounded memory.

Decoders differ in what they do with a truncated file (older OpenCV versions fill the rest with grey), and a run should
report it in its first second, not at frame 400. JPEG and PNG files are checked by their end markers; other formats are
left to the decoder.

Pillow keeps everything that it reads from a header, and thousands of TIFF or EXIF tags can refer to the same bytes:
Pillow 12.3 allocates 1.8 GB for half a megabyte. Therefore it reads through a `HeaderReader`.
"""

from __future__ import annotations

import io
import struct
import warnings
from dataclasses import dataclass
from typing import BinaryIO

from PIL import JpegImagePlugin, TiffImagePlugin

__all__ = ["HEADER_ERRORS", "HeaderReader", "ImageHeader", "JpegHeader", "read_image_header", "read_tiff_directory"]

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_END = b"IEND\xaeB`\x82"
JPEG_SIGNATURE = b"\xff\xd8"
JPEG_END = b"\xff\xd9"
# Limit on what is read of a header: these bytes plus half of the file; each call adds so many.
HEADER_BYTES, CALL_BYTES = 1 << 23, 1 << 7

HEADER_ERRORS = (SyntaxError, OSError, LookupError, TypeError, ValueError, ArithmeticError, struct.error)
"""What Pillow raises for malformed headers."""

# Pillow warns of malformed tags. The filter is global because `warnings.catch_warnings` is not safe with threads.
warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.TiffImagePlugin")


@dataclass(frozen=True)
class ImageHeader:
    """What a file's structure tells.

    width, height: stored size in pixels, before any EXIF orientation; 0 where the header is damaged. complete: the end
    marker is there.
    """

    width: int
    height: int
    complete: bool


class HeaderReader(io.BufferedIOBase):
    """A file object that raises OSError once more than a header has been read through it."""

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


class JpegHeader(JpegImagePlugin.JpegImageFile):
    """Pillow's JPEG reader: once it is constructed, the file stands at the first coded byte. Raises `HEADER_ERRORS`."""

    def _read_dpi_from_exif(self) -> None:
        """Not needed: Pillow would unpack all of EXIF, which costs memory."""


def read_image_header(file: BinaryIO) -> ImageHeader | None:
    """The header of an opened JPEG or PNG file; None for other formats and for files that are neither."""
    signature = file.read(8)
    if signature == PNG_SIGNATURE:
        # Without Pillow, which would unpack the texts and the colour profile that follow: the size has a fixed place.
        chunk = file.read(16)
        if len(chunk) < 16 or chunk[4:8] != b"IHDR":
            return ImageHeader(0, 0, complete=False)
        width, height = struct.unpack(">II", chunk[8:])
        return ImageHeader(width, height, _ends_with(file, PNG_END))
    if signature[:2] != JPEG_SIGNATURE:
        return None
    file.seek(0)
    try:
        width, height = JpegHeader(HeaderReader(file)).size
    except HEADER_ERRORS:
        file.seek(-min(2, file.seek(0, 2)), 2)
        return ImageHeader(0, 0, complete=file.read() == JPEG_END)
    # Coded data never holds FF D9 except as the end marker, so the first one after the scan's start is it.
    return ImageHeader(width, height, _ends_with(file, JPEG_END))


def read_tiff_directory(data: bytes, offset: int | None = None) -> TiffImagePlugin.ImageFileDirectory_v2:
    """Tags of the directory at `offset` of a TIFF structure, by default of its first one.

    Of a directory that is damaged or too large, only the tags before that place. Raises `HEADER_ERRORS`.
    """
    file = HeaderReader(io.BytesIO(data))
    # The byte order is passed separately: Pillow recognises BigTIFF in little-endian order only.
    start = b"II+\0" + data[4:16] if data[2:4] in (b"+\0", b"\0+") else b"II*\0" + data[4:8]
    directory = TiffImagePlugin.ImageFileDirectory_v2(start, prefix=data[:2])
    file.seek(directory.next if offset is None else offset)
    directory.load(file)
    return directory


def _ends_with(file: BinaryIO, marker: bytes) -> bool:
    """Whether the marker closes the file or comes before something appended to it (motion photos)."""
    here = file.tell()
    end = file.seek(0, 2)
    if end - here < len(marker):
        return False
    file.seek(end - len(marker))
    if file.read() == marker:
        return True
    file.seek(here)
    return marker in file.read()
