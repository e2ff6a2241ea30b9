"""Focal length from EXIF headers."""

from __future__ import annotations

from pathlib import Path

from PIL import ExifTags

from modp_ti.files import open_file
from modp_ti.inputs.sources.image_header import HEADER_ERRORS, JpegHeader, bounded, read_tiff_directory

__all__ = ["focal_length_35mm"]


def focal_length_35mm(path: Path) -> float | None:
    """Read the focal length in 35 mm equivalent [mm] from a JPEG file, or return None if it is not stated."""
    try:
        with open_file(path) as file:
            tiff = JpegHeader(bounded(file)).info["exif"].removeprefix(b"Exif\0\0")
        inner = read_tiff_directory(tiff)[ExifTags.IFD.Exif]
        value = read_tiff_directory(tiff, inner)[ExifTags.Base.FocalLengthIn35mmFilm]
    except HEADER_ERRORS:  # also raised if EXIF or the tag is missing
        return None
    return float(value) if isinstance(value, int) and value > 0 else None
