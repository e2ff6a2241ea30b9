"""Images are turned as their EXIF orientation says. OpenCV and Pillow do so too, and say what is right."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageOps

from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.sources import Distortion, ImageFolder
from modp_ti.inputs.sources.orientation import Turn, turn_of_exif

pillow_heif = pytest.importorskip("pillow_heif")
STORED = cv2.resize(np.random.default_rng(4).integers(0, 255, (4, 6, 3), dtype=np.uint8), (48, 32))
ORIENTATIONS = range(1, 9)


def write(file: Path, stored: NDArray[np.uint8], orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    if file.suffix == ".heic":  # Pillow would write it upright
        pillow_heif.from_pillow(Image.fromarray(stored)).save(file, quality=98, exif=exif.tobytes())
    else:
        Image.fromarray(stored).save(file, exif=exif, quality=98)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif", ".avif", ".heic"])
@pytest.mark.parametrize("orientation", [1, 2, 5, 6])
def test_images_of_every_format_are_turned_upright_and_a_note_says_so(tmp_path, suffix, orientation):
    """Images of one size are turned like the first, but those of HEIC, which its decoder turns, each by itself."""
    (tmp_path / "images").mkdir()
    for name, stated in (("a", orientation), ("b", orientation if suffix == ".heic" else 1)):
        write(tmp_path / f"images/{name}{suffix}", STORED, stated)
    write(tmp_path / "same.png", STORED, orientation)
    images = ImageFolder(tmp_path / "images")
    expected = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / "same.png")).convert("RGB"))
    for name in images.names:
        assert images.size(name) == expected.shape[1::-1]
        error = np.abs(images.read(name).astype(int) - expected)
        assert error.mean() < 6 and (error.max() == 0 or suffix in (".jpg", ".webp", ".avif", ".heic"))
    assert len(images.notes) == (orientation != 1 and suffix != ".heic")


def test_images_of_one_camera_that_differ_in_orientation_are_turned_like_the_first(tmp_path):
    for i, orientation in enumerate((6, 1, 3, 8)):
        write(tmp_path / f"{i}.jpg", STORED, orientation)
    images = ImageFolder(tmp_path)
    first = images.read("0.jpg")
    assert first.shape == (48, 32, 3)
    for name in images.names:
        assert images.size(name) == (32, 48)
        np.testing.assert_array_equal(images.read(name), first)
    (note,) = images.notes
    assert "differ" in note and "turned clockwise by 90 degrees" in note


def test_images_of_several_sizes_are_turned_one_by_one(tmp_path):
    """Of one upright picture, stored in all eight ways."""
    for orientation in ORIENTATIONS:
        turn = turn_of_exif(orientation)
        stored = np.rot90(STORED, turn.quarters)
        write(tmp_path / f"{orientation}.jpg", stored[:, ::-1] if turn.mirrored else stored, orientation)
    images = ImageFolder(tmp_path)
    for name in images.names:
        assert images.size(name) == (48, 32)
        assert np.abs(images.read(name).astype(int) - STORED).mean() < 3.0
    assert len(images.notes) == 1 and "7 of 8 images" in images.notes[0]


@pytest.mark.parametrize("quarters", range(4))
def test_a_turned_camera_sees_turned_rays_at_turned_pixels(quarters):
    turn, size = Turn(quarters), (640, 480)
    stored, lens = PinholeCamera(500.0, 510.0, 310.0, 250.0, *size), Distortion((0.1, -0.05), tangential=(0.02, -0.01))
    rays = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 2))
    rays = np.c_[rays, np.ones(20)]

    def projected(camera: PinholeCamera, lens: Distortion, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        coefficients = np.array([*lens.numerator, *lens.tangential])
        return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix(), coefficients)[0][:, 0]

    turned = projected(*turn.camera(stored, lens), rays @ turn.T_turned_stored[:3, :3].T)
    np.testing.assert_allclose(turn.pixels(projected(stored, lens, rays), *size), turned, atol=1e-9)
    # A white pixel of the image goes where its centre goes.
    image = np.zeros((480, 640, 3), np.uint8)
    image[100, 30] = 255
    y, x, _ = np.argwhere(turn.image(image))[0]
    np.testing.assert_allclose(turn.pixels(np.array([[30.5, 100.5]]), *size), [[x + 0.5, y + 0.5]])
