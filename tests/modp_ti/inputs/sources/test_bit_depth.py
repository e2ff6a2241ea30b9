"""Grey images, and images of 16 bits of which a camera uses fewer."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from modp_ti.inputs.sources import ImageFolder

RAMP = np.linspace(0.0, 1.0, 64).reshape(8, 8)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".pgm"])
def test_grey_images_of_8_bits_keep_their_values(tmp_path, suffix):
    grey = np.rint(255 * RAMP).astype(np.uint8)
    cv2.imwrite(str(tmp_path / f"a{suffix}"), grey)
    images = ImageFolder(tmp_path)
    image = images.read(f"a{suffix}")
    assert image.dtype == np.uint8 and (image == image[..., :1]).all()
    assert np.abs(image[..., 0].astype(int) - grey).max() <= (6 if suffix == ".jpg" else 0)
    assert images.notes == []


@pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm"])
@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("channels", [1, 3])
def test_the_used_bits_of_16_give_the_whole_range(tmp_path, suffix, bits, channels):
    if suffix == ".pgm" and channels == 3:
        suffix = ".ppm"
    deep = np.rint((2**bits - 1) * RAMP).astype(np.uint16)
    for i, share in enumerate((0.4, 1.0, 0.7)):  # the first image is darker
        image = (share * deep).astype(np.uint16)
        cv2.imwrite(str(tmp_path / f"{i}{suffix}"), image if channels == 1 else np.dstack([image] * 3))
    images = ImageFolder(tmp_path)
    images.size(images.names[0])
    for i, share in enumerate((0.4, 1.0, 0.7)):
        assert np.abs(images.read(f"{i}{suffix}") - 255 * share * RAMP[..., None]).max() < 2.0
    assert images.notes == [] if bits == 16 else f"use {bits}" in images.notes[0]


def test_brighter_images_than_those_that_were_looked_at_saturate(tmp_path):
    for i in range(40):
        cv2.imwrite(str(tmp_path / f"{i:02d}.png"), np.full((8, 8), 900 if i != 39 else 3000, np.uint16))
    images = ImageFolder(tmp_path)
    assert images.read("00.png").max() == 900 >> 2
    assert images.read("39.png").min() == 255
