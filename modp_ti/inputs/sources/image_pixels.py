"""Decoding of an image file's bytes to 8-bit sRGB: with OpenCV, HEIC with pillow-heif, and AVIF with Pillow."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

from modp_ti.files.terminal import quiet_libraries
from modp_ti.inputs.sources.image_header import HEADER_ERRORS, ImageHeader, heif_kind, open_image
from modp_ti.inputs.sources.orientation import turn_of_exif
from modp_ti.inputs.sources.tone_mapping import ToneMapping, Transfer

DEPTHS = (8, 10, 12, 14, 16)
"""Depths of cameras [bits] whose values are stored in 16 bits."""

# Largest difference of a colour [of 255] from sRGB of a profile that is taken for it. Adobe RGB differs by 60.
SAME = 3


def decoded(data: bytes, header: ImageHeader | None = None, bits: int = DEPTHS[-1]) -> NDArray[np.uint8] | None:
    """Decode an image file's bytes to (H, W, 3) uint8 RGB, without EXIF rotation (HEIC upright); None if that fails.

    Args:
        data: The file's content.
        header: The file's header, whose colour profile is applied; None to keep the colours as they are stored.
        bits: How many bits an image of 16 bits per channel uses.
    """
    import cv2

    profile = b"" if header is None else header.profile
    if heif_kind(data[:64]) is not None:
        image = _decoded_heif(data)
        return None if image is None else in_srgb(image, profile)
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = decoded_as(data, flags) if bits == DEPTHS[-1] else decoded_deep(data)
    if image is None:
        return None
    rgb = np.asarray(cv2.cvtColor(reduced(image, bits), cv2.COLOR_BGR2RGB), dtype=np.uint8)
    return _as_stored(in_srgb(rgb, profile), header)


def decoded_as(data: bytes, flags: int) -> NDArray | None:
    """Decode an image file's bytes with OpenCV's flags, BGR and silently; None if that fails."""
    import cv2

    with quiet_opencv():
        try:
            return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error:
            return None


def decoded_deep(data: bytes) -> NDArray | None:
    """Decode an image file's bytes to (H, W, 3) BGR, uint8 or uint16 as it is stored; None if that fails."""
    import cv2

    image = decoded_as(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    return image if image is not None and image.dtype in (np.uint8, np.uint16) else None


def alpha_of(data: bytes, header: ImageHeader | None) -> NDArray[np.bool_] | None:
    """Return where the alpha of an image file's content is at least half (H, W); None if it has no alpha."""
    import cv2

    image = decoded_as(data, cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3 or image.shape[2] != 4 or image.dtype not in (np.uint8, np.uint16):
        return None
    return _as_stored(image[..., 3] > np.iinfo(image.dtype).max // 2, header)


def _as_stored(image: NDArray[Any], header: ImageHeader | None) -> NDArray[Any]:
    """Undo what OpenCV does to the image of a TIFF file, which it turns as EXIF says."""
    if header is None or not header.is_tiff or header.orientation == 1:
        return image
    return np.ascontiguousarray(turn_of_exif(header.orientation).stored(image))


def _decoded_heif(data: bytes) -> NDArray[np.uint8] | None:
    """Decode a HEIC or AVIF file to (H, W, 3) uint8 RGB; None if that fails.

    HEIC is turned upright, AVIF is not. HDR (PQ or HLG) HEIC is tone-mapped; of other images with more than 8 bits, the
    first 8 are kept.
    """
    try:
        image = open_image(io.BytesIO(data))
        number, bits = (
            image.info.get("nclx_profile", {}).get("transfer_characteristics"),
            image.info.get("bit_depth", 8),
        )
        transfer = next((each for each in Transfer if each.value == number), None)
        if transfer is not None and bits > 8:
            import pillow_heif

            deep = np.asarray(pillow_heif.open_heif(data, convert_hdr_to_8bit=False))
            if deep.dtype == np.uint16 and deep.ndim == 3:
                # The bits are in the highest places: 1023 of 10 bits is 65472.
                return ToneMapping(transfer)(deep[..., :3] | deep[..., :3] >> bits)
        return np.asarray(image.convert("RGB"))
    except HEADER_ERRORS:
        return None


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silence OpenCV and its libraries on the terminal within the block. Errors are reported by the caller."""
    import cv2

    log_level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        with quiet_libraries():
            yield
    finally:
        cv2.utils.logging.setLogLevel(log_level)


# ---- 16 bits -----------------------------------------------------------------------------------------------------


def used_bits(images: Iterable[NDArray], source: Path) -> tuple[int, list[str]]:
    """Return the smallest depth [bits] of a camera that holds all values of the images (uint8 or uint16).

    With it comes a remark on their source, if they do not use all of 16 bits.
    """
    largest = max((int(image.max()) for image in images), default=0)
    bits = next(bits for bits in DEPTHS if largest < 1 << bits)
    note = f"{source}: the images have 16 bits and use {bits}: {(1 << bits) - 1} is taken as white"
    return bits, [note] if bits < DEPTHS[-1] else []


def reduced(image: NDArray, bits: int) -> NDArray[np.uint8]:
    """Return an image of `bits` used bits (uint16) with 8 bits; larger values saturate. uint8 images stay as they are.

    A fixed scale keeps the brightness of a recording's images comparable.
    """
    if image.dtype == np.uint8:
        return image
    return np.minimum(image >> (bits - 8), 255).astype(np.uint8)


# ---- colour profiles ---------------------------------------------------------------------------------------------


def in_srgb(image: NDArray[np.uint8], profile: bytes) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) in sRGB. Without a profile of other colours it is returned as it is."""
    way = way_to_srgb(profile)
    return image if way is None else np.array(way.apply(Image.fromarray(image)), dtype=np.uint8)


@lru_cache(maxsize=64)
def way_to_srgb(profile: bytes) -> ImageCms.ImageCmsTransform | None:
    """Return the conversion from a profile to sRGB; None if it is not of RGB, is damaged, or has sRGB's colours."""
    if profile[16:20] != b"RGB ":
        return None
    levels = np.arange(0, 256, 51, dtype=np.uint8)
    grid = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(6, 36, 3)
    try:
        given, wanted = ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
        way = ImageCms.ImageCmsTransform(given, ImageCms.ImageCmsProfile(wanted), "RGB", "RGB")
        difference = np.abs(np.asarray(way.apply(Image.fromarray(grid))).astype(int) - grid)
    except (ImageCms.PyCMSError, OSError, ValueError):
        return None
    return way if difference.max() > SAME else None
