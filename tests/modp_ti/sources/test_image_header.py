"""Sizes and cut-off files are told from the file's structure alone."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest

from modp_ti.sources.image_header import read_image_header

IMAGE = np.random.default_rng(0).integers(0, 255, (37, 53, 3), dtype=np.uint8)


def encoded(suffix: str, *parameters: int) -> bytes:
    return cv2.imencode(suffix, IMAGE, parameters)[1].tobytes()


FILES = {
    "png": encoded(".png"),
    "jpeg": encoded(".jpg"),
    "progressive": encoded(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restarts": encoded(".jpg", cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
}


@pytest.mark.parametrize("kind", FILES)
def test_whole_file_has_its_size_and_is_complete(kind):
    header = read_image_header(io.BytesIO(FILES[kind]))
    assert (header.width, header.height, header.complete) == (53, 37, True)


@pytest.mark.parametrize("kind", FILES)
def test_file_cut_off_anywhere_is_not_complete(kind):
    data = FILES[kind]
    for length in [*range(8, len(data), 97), len(data) - 2, len(data) - 1]:
        assert not read_image_header(io.BytesIO(data[:length])).complete, length


@pytest.mark.parametrize("kind", FILES)
def test_something_appended_does_not_make_it_incomplete(kind):
    assert read_image_header(io.BytesIO(FILES[kind] + b"video" * 100)).complete


def test_thumbnail_with_its_own_end_marker_does_not_hide_a_cut():
    thumbnail = b"Exif\0\0" + FILES["jpeg"]
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    whole = FILES["jpeg"][:2] + segment + FILES["jpeg"][2:]
    header = read_image_header(io.BytesIO(whole))
    assert (header.width, header.height, header.complete) == (53, 37, True)
    assert not read_image_header(io.BytesIO(whole[:-200])).complete


def test_other_files_are_left_to_the_decoder():
    assert read_image_header(io.BytesIO(encoded(".bmp"))) is None
    assert read_image_header(io.BytesIO(b"")) is None
