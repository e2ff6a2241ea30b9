"""HEIC and AVIF photographs are read upright, with their size, focal length and HDR; damaged ones are named.

FFmpeg, which decodes a file's only picture as it is stored, reads them independently.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import ExifTags, Image

from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.sources import ImageFolder
from modp_ti.inputs.sources.heif import decoded_heif, heif_size
from modp_ti.inputs.sources.image_bounds import why_undecodable
from modp_ti.inputs.sources.image_header import focal_length_35mm
from modp_ti.inputs.sources.tone_mapping import ToneMapping, Transfer

pillow_heif = pytest.importorskip("pillow_heif")

ORIENTATION, FOCAL_LENGTH = 0x0112, 0xA405


def picture() -> Image.Image:
    """96x64, smooth, with another colour in each corner."""
    down, right = np.mgrid[0:1:64j, 0:1:96j]
    return Image.fromarray(np.round(np.stack([200 * down, 200 * right, 100 + 0 * right], axis=2)).astype(np.uint8))


def exif(orientation: int) -> bytes:
    tags = Image.Exif()
    tags[ORIENTATION] = orientation
    tags.get_ifd(ExifTags.IFD.Exif)[FOCAL_LENGTH] = 26
    return tags.tobytes()


def photograph(form: str, orientation: int = 1) -> bytes:
    stream = io.BytesIO()
    if form == "heic":
        pillow_heif.from_pillow(picture()).save(stream, quality=95, chroma=444, exif=exif(orientation))
    else:
        picture().save(stream, "AVIF", quality=95, subsampling="4:4:4", exif=exif(orientation))
    return stream.getvalue()


def by_ffmpeg(data: bytes) -> np.ndarray:
    with av.open(io.BytesIO(data)) as file:
        return next(file.decode(video=0)).to_ndarray(format="rgb24")


# Of the turned picture, from the stored one.
TURNED = {
    1: lambda a: a,
    3: lambda a: a[::-1, ::-1],
    6: lambda a: np.rot90(a, -1),
    8: np.rot90,
    2: lambda a: a[:, ::-1],
}


@pytest.mark.parametrize("orientation", TURNED)
@pytest.mark.parametrize("form", ["heic", "avif"])
def test_photographs_are_turned_upright_once(tmp_path, form, orientation):
    data = photograph(form, orientation)
    (tmp_path / f"IMG_1.{form.upper()}").write_bytes(data)
    images = ImageFolder(tmp_path)
    (name,) = images.names
    read = images.read(name)
    assert images.size(name) == read.shape[1::-1]
    expected = TURNED[orientation](np.asarray(picture()))
    assert read.shape == expected.shape
    assert np.abs(read.astype(int) - expected).max() <= 6
    stored = TURNED[orientation](by_ffmpeg(data)[:64, :96])
    assert np.abs(read.astype(int) - stored).max() <= 3


@pytest.mark.parametrize("form", ["heic", "avif"])
def test_the_focal_length_of_the_lens_is_found(tmp_path, form):
    (tmp_path / "a").write_bytes(photograph(form))
    assert focal_length_35mm(tmp_path / "a") == 26.0


def test_hdr_photographs_are_tone_mapped():
    signal = np.round(np.linspace(0, 65535, 96)[None, :, None] * np.ones((64, 1, 3))).astype(np.uint16)
    stream = io.BytesIO()
    made = pillow_heif.from_bytes("RGB;16", (96, 64), signal.tobytes())
    made.save(stream, quality=-1, chroma=444, color_primaries=9, transfer_characteristics=16, matrix_coefficients=9)
    read, expected = decoded_heif(stream.getvalue()), ToneMapping(Transfer.PQ)(signal)
    assert read is not None and np.abs(read.astype(int) - expected).max() <= 2


@pytest.mark.parametrize("form", ["heic", "avif"])
def test_damaged_photographs_are_named(tmp_path, form):
    whole = photograph(form)
    size = whole.index(b"ispe") + 8
    cases = {
        "cut off": whole[: len(whole) * 2 // 3],
        "noise": whole[:12] + np.random.default_rng(3).bytes(500),
        "huge": whole[:size] + b"\0\1\0\0\0\1\0\0" + whole[size + 8 :],
        "no_boxes": whole[:32],
    }
    for name, data in cases.items():
        folder = tmp_path / name
        folder.mkdir()
        (folder / f"a.{form}").write_bytes(data)
        images = ImageFolder(folder)
        with pytest.raises(UnreadableImageError, match=f"a.{form}: unreadable image"):
            images.read(images.names[0])
    assert "more than" in str(why_undecodable(cases["huge"]))
    assert heif_size(whole) >= (64, 64)


def test_without_the_package_its_name_is_told(tmp_path, monkeypatch):
    (tmp_path / "a.heic").write_bytes(photograph("heic"))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    images = ImageFolder(Path(tmp_path))
    with pytest.raises(InputError, match=r"pip install 'modp-ti\[heic\]'"):
        images.size("a.heic")
