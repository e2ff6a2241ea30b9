"""HEIC photographs, decoded by pillow-heif, and AVIF ones, decoded by Pillow."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.tone_mapping import ToneMapping, Transfer

__all__ = ["BRANDS", "HeifHeader", "decoded_heif", "heif_size", "is_heif", "read_heif_header"]

BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"mif2", b"msf1", b"miaf", b"avif", b"avis")
"""What a file's first box may name first."""
# What the libraries raise for malformed files.
ERRORS = (SyntaxError, OSError, LookupError, TypeError, ValueError, ArithmeticError, RuntimeError, EOFError)
EXIF_START = b"Exif\0\0"


@dataclass(frozen=True)
class HeifHeader:
    """What a file says without being decoded.

    Attributes:
        width: Width [px] of the decoded image.
        height: Height [px], likewise.
        orientation: EXIF orientation that is left to apply: 1 for HEIC, whose rotation the decoder applies.
        tiff: The TIFF structure of EXIF; empty without.
        profile: ICC profile of the colours; empty without.
    """

    width: int
    height: int
    orientation: int
    tiff: bytes
    profile: bytes


def is_heif(start: bytes) -> bool:
    """Return whether a file with these first 12 bytes is HEIC or AVIF."""
    return start[4:8] == b"ftyp" and start[8:12] in BRANDS


def heif_size(data: bytes) -> tuple[int, int]:
    """Return the largest size (width, height) that a file's boxes state. Raises ValueError if there is none."""
    sizes = []
    for meta in _boxes(data, b"meta", 0, len(data)):
        for properties in _boxes(data, b"iprp", meta[0] + 4, meta[1]):
            for container in _boxes(data, b"ipco", *properties):
                for start, end in _boxes(data, b"ispe", *container):
                    if end - start >= 12:
                        width, height = (int.from_bytes(data[start + at : start + at + 4], "big") for at in (4, 8))
                        sizes.append((width, height))
    if not sizes:
        raise ValueError("no box ispe")
    return max(sizes, key=lambda size: size[0] * size[1])


def read_heif_header(data: bytes) -> HeifHeader | None:
    """Read a file's header; None if it is damaged.

    Raises:
        InputError: If the package that reads such files is missing.
    """
    try:
        if _is_avif(data):
            image = _avif(data)
            tiff, orientation = image.info.get("exif"), image.getexif().get(ExifTags.Base.Orientation, 1)
        else:
            image = _heic(data)
            tiff, orientation = image.info["exif"], 1
        profile = image.info.get("icc_profile") or b""
        return HeifHeader(*image.size, orientation, (tiff or b"").removeprefix(EXIF_START), profile)
    except ERRORS:
        return None


def decoded_heif(data: bytes) -> NDArray[np.uint8] | None:
    """Decode a file to (H, W, 3) uint8 RGB; None if that fails, or if it has another size than stated.

    HEIC is turned upright, AVIF is not. HDR (PQ or HLG) HEIC is tone-mapped; of other images with more
    than 8 bits, the first 8 are kept.

    Raises:
        InputError: If the package that reads such files is missing.
    """
    try:
        if _is_avif(data):
            image = _avif(data)
            stated = image.size
            return _of_size(np.asarray(image.convert("RGB")), stated)
        image = _heic(data)
        stated = image.size
        number, bits = image.info.get("nclx_profile", {}).get("transfer_characteristics"), image.info["bit_depth"]
        transfer = next((each for each in Transfer if each.value == number), None)
        if transfer is not None and bits > 8:
            deep = np.asarray(_heic(data, deep=True))
            if deep.dtype == np.uint16 and deep.ndim == 3:
                # The bits are in the highest places: 1023 of 10 bits is 65472.
                return _of_size(ToneMapping(transfer)(deep[..., :3] | deep[..., :3] >> bits), stated)
        return _of_size(np.asarray(image.to_pillow().convert("RGB")), stated)
    except ERRORS:
        return None


def _boxes(data: bytes, wanted: bytes, start: int, end: int) -> Iterator[tuple[int, int]]:
    """Yield start and end of the content of the boxes of one type in a range of the file.

    A box starts with 4 bytes of length and 4 of type. Length 1 means that 8 bytes of length follow, 0 that the box
    extends to the end.
    """
    while start + 8 <= end:
        length, head = int.from_bytes(data[start : start + 4], "big"), 8
        if length == 1:
            length, head = int.from_bytes(data[start + 8 : start + 16], "big"), 16
        stop = end if length == 0 else min(start + max(length, head), end)
        if data[start + 4 : start + 8] == wanted:
            yield start + head, stop
        start = stop


def _of_size(image: NDArray[np.uint8], stated: tuple[int, int]) -> NDArray[np.uint8] | None:
    """Return the image if it has the stated size (width, height), otherwise None."""
    return image if image.shape[1::-1] == stated else None


def _is_avif(data: bytes) -> bool:
    """Return whether the brands of the first box name AVIF."""
    first = data[8 : min(int.from_bytes(data[:4], "big"), 256)]
    return any(first[at : at + 4] in (b"avif", b"avis") for at in range(0, len(first), 4))


def _avif(data: bytes) -> Image.Image:
    try:
        from PIL import AvifImagePlugin

    except ImportError:
        raise InputError("AVIF photographs need a newer package: pip install 'pillow>=11.3'") from None
    return AvifImagePlugin.AvifImageFile(io.BytesIO(data))


def _heic(data: bytes, deep: bool = False):
    """Open a HEIC file, whose primary image is decoded when its pixels are asked for; with 16 bits if `deep`."""
    try:
        import pillow_heif
    except ImportError:
        raise InputError("HEIC photographs need a package: pip install 'modp-ti[heic]'") from None
    return pillow_heif.open_heif(data, convert_hdr_to_8bit=not deep)
