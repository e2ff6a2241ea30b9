"""Pictures of every format with a colour profile come in sRGB. The profile is sRGB's with red and blue exchanged."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image, ImageCms

from modp_ti.inputs.sources import ImageFolder
from modp_ti.inputs.sources.colour_profile import in_srgb

SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
RNG = np.random.default_rng(2)
PICTURE = np.repeat(np.repeat(RNG.integers(0, 255, (3, 4, 3), dtype=np.uint8), 16, 0), 16, 1)
FORMATS = {".jpg": "JPEG", ".png": "PNG", ".webp": "WEBP", ".tif": "TIFF", ".avif": "AVIF", ".heic": "HEIF"}


def exchanged() -> bytes:
    """The tag table holds each name once, after the header of 128 bytes."""
    table = bytearray(SRGB)
    red, blue = table.index(b"rXYZ", 128), table.index(b"bXYZ", 128)
    table[red : red + 4], table[blue : blue + 4] = b"bXYZ", b"rXYZ"
    return bytes(table)


def saved(suffix: str, profile: bytes) -> bytes:
    stream = io.BytesIO()
    if suffix == ".heic":
        pytest.importorskip("pillow_heif").register_heif_opener()
    options = {"lossless": True} if suffix == ".webp" else {"quality": 95}
    Image.fromarray(PICTURE).save(stream, FORMATS[suffix], icc_profile=profile, **options)
    return stream.getvalue()


@pytest.mark.parametrize("suffix", FORMATS)
def test_colours_of_another_profile_are_converted_and_those_of_srgb_are_kept(tmp_path, suffix):
    for name, profile in (("plain", b""), ("same", SRGB), ("other", exchanged())):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"a{suffix}").write_bytes(saved(suffix, profile))
    plain, same, other = (ImageFolder(tmp_path / name) for name in ("plain", "same", "other"))
    stored = plain.read(f"a{suffix}")
    np.testing.assert_array_equal(same.read(f"a{suffix}"), stored)
    assert np.abs(other.read(f"a{suffix}").astype(int) - stored[..., ::-1]).max() <= 2
    assert (len(same.notes), len(other.notes)) == (0, 1)


@pytest.mark.parametrize("profile", [b"", b"no profile", exchanged()[:200], SRGB[:16] + b"GRAY" + SRGB[20:]])
def test_a_profile_that_cannot_be_applied_changes_nothing(profile):
    assert in_srgb(PICTURE, profile) is PICTURE
