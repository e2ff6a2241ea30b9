"""Sizes and cut-off files are told from the file's structure alone."""

from __future__ import annotations

import io
import itertools
import struct
import tracemalloc

import cv2
import numpy as np
import pytest

from modp_ti.inputs.sources.image_header import read_image_header, read_tiff_directory

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


def test_a_header_that_is_damaged_is_told_from_a_file_that_was_cut_off():
    header = read_image_header(io.BytesIO(b"\xff\xd8" + bytes(100) + b"\xff\xd9"))
    assert (header.width, header.height, header.complete) == (0, 0, True)


def test_bytes_between_segments_are_passed_over_up_to_an_end():
    data = FILES["jpeg"]
    assert read_image_header(io.BytesIO(data[:2] + b"\xff" * 500 + data[2:])).width == 53
    assert not read_image_header(io.BytesIO(data[:2] + b"\xff" * 200_000 + data[2:] + b"x")).complete


def test_long_headers_are_read_for_what_they_are_worth():
    """A photograph with its depth in it is read; a file that is all header costs no more memory than is promised."""
    segment = b"\xff\xe1" + (65_002).to_bytes(2, "big") + bytes(65_000)
    for segments, is_read in ((90, True), (1000, False)):
        data = FILES["jpeg"][:2] + segments * segment + FILES["jpeg"][2:]
        tracemalloc.start()
        header = read_image_header(io.BytesIO(data))
        allocated = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert header.complete
        assert (header.width == 53) == is_read
        assert allocated < (16 << 20) + len(data)


def test_tags_of_a_tiff_are_read_in_all_its_forms_and_cost_no_memory():
    for order, big in itertools.product("<>", (False, True)):
        mark = {"<": b"II", ">": b"MM"}[order] + struct.pack(order + "H", 43 if big else 42)
        mark += struct.pack(order + ("HHQ" if big else "I"), *((8, 0, 16) if big else (8,)))
        count, entry = ("Q", "HHQQ") if big else ("H", "HHII")
        room = 1 << 17
        whole = 16 if big else 4
        tags = [(256, whole, 1), (257, whole, 1), *((300 + i, 7, room) for i in range(1000))]
        start = len(mark) + struct.calcsize(order + count) + len(tags) * struct.calcsize(order + entry)
        data = mark + struct.pack(order + count, len(tags))
        data += b"".join(struct.pack(order + entry, *tag, start if tag[2] > 1 else 77) for tag in tags) + bytes(room)
        tracemalloc.start()
        found = read_tiff_directory(data)
        allocated = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert (found[256], found[257]) == (77, 77), (order, big)
        assert allocated < (16 << 20) + 2 * len(data)


def test_other_files_are_left_to_the_decoder():
    assert read_image_header(io.BytesIO(encoded(".bmp"))) is None
    assert read_image_header(io.BytesIO(b"")) is None
