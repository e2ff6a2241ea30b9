"""One image file of every format: its header without decoding, its pixels in upright sRGB, and what is refused."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image, ImageCms

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources import ImageFolder, image_header
from modp_ti.inputs.sources.image_header import decodable, focal_length_35mm
from modp_ti.inputs.sources.image_pixels import decoded
from modp_ti.inputs.sources.tone_mapping import ToneMapping, Transfer

pillow_heif = pytest.importorskip("pillow_heif")
pillow_heif.register_heif_opener()

PILLOW = {".jpg": "JPEG", ".png": "PNG", ".webp": "WEBP", ".tif": "TIFF", ".avif": "AVIF", ".heic": "HEIF"}
OPENCV = [".png", ".jpg", ".bmp", ".tiff", ".webp", ".ppm", ".pgm", ".jp2"]
NOISE = np.random.default_rng(0).integers(0, 255, (37, 53, 3), dtype=np.uint8)
SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
RNG = np.random.default_rng(2)
PATCHES = np.repeat(np.repeat(RNG.integers(0, 255, (3, 4, 3), dtype=np.uint8), 16, 0), 16, 1)
RAMP = np.linspace(0.0, 1.0, 64).reshape(8, 8)
HEIF = ["heic", "avif"]


def encoded(suffix: str, *parameters: int, image: np.ndarray = NOISE) -> bytes:
    image = image[..., 0] if suffix == ".pgm" and image.ndim == 3 else image
    return cv2.imencode(suffix, image, parameters)[1].tobytes()


def saved(suffix: str, image: np.ndarray = PATCHES, **options: object) -> bytes:
    with io.BytesIO() as stream:
        lossless = {"lossless": True} if suffix == ".webp" else {"quality": 95}
        Image.fromarray(image).save(stream, PILLOW[suffix], **lossless, **options)
        return stream.getvalue()


# ---- headers and limits ------------------------------------------------------------------------------------------

WITH_END = {
    "png": encoded(".png"),
    "jpeg": encoded(".jpg"),
    "progressive": encoded(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restarts": encoded(".jpg", cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
    "heic": saved(".heic"),
    "avif": saved(".avif"),
}


@pytest.mark.parametrize("kind", WITH_END)
def test_a_file_that_is_cut_off_anywhere_is_not_complete(kind: str) -> None:
    data = WITH_END[kind]
    header, image = decodable(data), decoded(data)
    assert image is not None and header.complete
    assert (header.width, header.height) == image.shape[1::-1]
    for length in [*range(8, len(data), 97), len(data) - 2, len(data) - 1]:
        with pytest.raises(OSError):
            decodable(data[:length])
    if kind not in HEIF:  # something may be appended, as in motion photos
        assert decodable(data + b"video" * 100).complete


@pytest.mark.parametrize("suffix", OPENCV)
def test_the_size_that_is_judged_is_the_images(suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data = encoded(suffix)
    assert (decodable(data).width, decodable(data).height) == (53, 37)
    for name, limit in (("MAX_IMAGE_PIXELS", 53 * 37 - 1), ("available_memory", lambda: 1000)):
        with monkeypatch.context() as limited:
            limited.setattr(image_header, name, limit)
            with pytest.raises(OSError, match="53x37"):
                decodable(data)


@pytest.mark.parametrize("data", [b"", b"GIF89a" + bytes(60), b"\0" * 100, b"P7\nWIDTH 4\n", b"RIFF1234WAVEfmt "])
def test_what_is_no_such_image_is_refused(data: bytes) -> None:
    with pytest.raises(OSError):
        decodable(data)


# ---- EXIF --------------------------------------------------------------------------------------------------------


def test_the_focal_length_is_found_where_it_is_stated(tmp_path: Path) -> None:
    def exif(value: object) -> bytes:
        made = Image.Exif()
        made.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = value
        return made.tobytes()

    cases = {suffix: (saved(suffix, exif=exif(26)), 26.0) for suffix in (".jpg", ".heic", ".avif")}
    others = {"zero": saved(".jpg", exif=exif(0)), "cut": saved(".jpg", exif=exif(26))[:40], "none": WITH_END["jpeg"]}
    for name, (data, expected) in {**cases, **{name: (data, None) for name, data in others.items()}}.items():
        (tmp_path / "a").write_bytes(data)
        assert focal_length_35mm(tmp_path / "a") == expected, name
    assert focal_length_35mm(tmp_path / "absent.jpg") is None


# ---- pixels ------------------------------------------------------------------------------------------------------


def exchanged() -> bytes:
    """The profile of sRGB with red and blue exchanged: the tag table holds each name once, after 128 bytes."""
    table = bytearray(SRGB)
    red, blue = table.index(b"rXYZ", 128), table.index(b"bXYZ", 128)
    table[red : red + 4], table[blue : blue + 4] = b"bXYZ", b"rXYZ"
    return bytes(table)


@pytest.mark.parametrize("suffix", PILLOW)
def test_colours_of_another_profile_are_converted_and_those_of_srgb_are_kept(tmp_path: Path, suffix: str) -> None:
    for name, profile in (("plain", b""), ("same", SRGB), ("other", exchanged())):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"a{suffix}").write_bytes(saved(suffix, icc_profile=profile))
    plain, same, other = (ImageFolder(tmp_path / name) for name in ("plain", "same", "other"))
    stored = plain.read(f"a{suffix}")
    np.testing.assert_array_equal(same.read(f"a{suffix}"), stored)
    assert np.abs(other.read(f"a{suffix}").astype(int) - stored[..., ::-1]).max() <= 2
    assert (len(same.notes), len(other.notes)) == (0, 1)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm", ".jpg"])
@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("channels", [1, 3])
def test_the_used_bits_of_16_give_the_whole_range(tmp_path: Path, suffix: str, bits: int, channels: int) -> None:
    suffix = ".ppm" if suffix == ".pgm" and channels == 3 else suffix
    kind = np.uint8 if suffix == ".jpg" else np.uint16
    white = 255 if suffix == ".jpg" else 2**bits - 1
    shares = (0.4, 1.0, 0.7)  # the first image is darker
    for i, share in enumerate(shares):
        image = (share * np.rint(white * RAMP)).astype(kind)
        cv2.imwrite(str(tmp_path / f"{i}{suffix}"), image if channels == 1 else np.dstack([image] * 3))
    images = ImageFolder(tmp_path)
    images.size(images.names[0])
    for i, share in enumerate(shares):
        image = images.read(f"{i}{suffix}")
        assert image.dtype == np.uint8 and (image == image[..., :1]).all()
        assert np.abs(image - 255 * share * RAMP[..., None]).max() < (7.0 if suffix == ".jpg" else 2.0)
    assert len(images.notes) == (bits < 16 and suffix != ".jpg")


def test_hdr_photographs_are_tone_mapped() -> None:
    signal = np.round(np.linspace(0, 65535, 96)[None, :, None] * np.ones((64, 1, 3))).astype(np.uint16)
    stream = io.BytesIO()
    made = pillow_heif.from_bytes("RGB;16", (96, 64), signal.tobytes())
    made.save(stream, quality=-1, chroma=444, color_primaries=9, transfer_characteristics=16, matrix_coefficients=9)
    read, expected = decoded(stream.getvalue()), ToneMapping(Transfer.PQ)(signal)
    assert read is not None and np.abs(read.astype(int) - expected).max() <= 2


def test_without_the_package_its_name_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.heic").write_bytes(saved(".heic"))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(InputError, match=r"modp-ti\[heic\]"):
        ImageFolder(tmp_path).size("a.heic")
