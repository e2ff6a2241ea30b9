"""What a photograph's EXIF header says of the lens."""

from __future__ import annotations

from pathlib import Path

from PIL import ExifTags

from modp_ti.files import open_file
from modp_ti.inputs.sources.image_header import HEADER_ERRORS, HeaderReader, JpegHeader, read_tiff_directory

__all__ = ["focal_length_35mm"]


def focal_length_35mm(path: Path) -> float | None:
    """Focal length [mm] that a camera of 24x36 mm film would need for the same view; None where the file says nothing.

    JPEG files only.
    """
    try:
        with open_file(path) as file:
            tiff = JpegHeader(HeaderReader(file)).info["exif"].removeprefix(b"Exif\0\0")
        inner = read_tiff_directory(tiff)[ExifTags.IFD.Exif]
        value = read_tiff_directory(tiff, inner)[ExifTags.Base.FocalLengthIn35mmFilm]
    except HEADER_ERRORS:  # also without EXIF or without the tag
        return None
    return float(value) if isinstance(value, int) and value > 0 else None
