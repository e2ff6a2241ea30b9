"""Masks and vignette belong to the stored images, and follow them through scaling and undistortion."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.inputs.source_settings import SourceSettings
from modp_ti.inputs.sources import Distortion, FrameReader, ImageFolder, Undistorter

WIDTH, HEIGHT = 64, 48
PINHOLE = PinholeCamera(60.0, 60.0, 32.0, 24.0, WIDTH, HEIGHT)
LENS = Distortion(numerator=(-0.25, 0.03))
COLOUR = (40, 160, 220)


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


@pytest.fixture
def images(tmp_path: Path) -> Path:
    """A folder with one image of one colour."""
    write(tmp_path / "images/a.png", np.full((HEIGHT, WIDTH, 3), COLOUR, np.uint8))
    return tmp_path / "images"


def reader(images: Path, **source: object) -> FrameReader:
    return FrameReader(ImageFolder(images), SourceSettings(path=images, **source))


def half_mask() -> np.ndarray:
    """Valid (white) in the left half."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, : WIDTH // 2] = 255
    return mask


@pytest.mark.parametrize("name", ["a.png", "a.bmp", "a.jpg", "a.png.png"])
def test_white_is_valid_and_black_is_not_in_any_image_format(images: Path, tmp_path: Path, name: str) -> None:
    write(tmp_path / "masks" / name, half_mask())
    picture = reader(images, masks=tmp_path / "masks").read("a.png", Undistorter(PINHOLE))
    np.testing.assert_array_equal(picture.mask, half_mask() > 0)


@pytest.mark.parametrize("place", ["masks/sub/a.png", "masks/a.png"])
def test_a_mask_lies_where_its_image_does_or_right_in_the_folder(images: Path, tmp_path: Path, place: str) -> None:
    write(images / "sub/a.png", np.full((HEIGHT, WIDTH, 3), COLOUR, np.uint8))
    write(tmp_path / place, half_mask())
    picture = reader(images, masks=tmp_path / "masks").read("sub/a.png", Undistorter(PINHOLE))
    np.testing.assert_array_equal(picture.mask, half_mask() > 0)


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.37])
@pytest.mark.parametrize("distortion", [Distortion(), LENS])
def test_a_mask_follows_its_image_and_no_ignored_colour_comes_into_a_valid_pixel(
    images: Path, tmp_path: Path, scale: float, distortion: Distortion
) -> None:
    """The image is black where it is masked, as masked images often are."""
    painted = np.full((HEIGHT, WIDTH, 3), COLOUR, np.uint8)
    painted[half_mask() == 0] = 0
    write(images / "a.png", painted)
    write(tmp_path / "masks/a.png", half_mask())
    undistorter = Undistorter(PINHOLE, distortion, scale)
    picture = reader(images, masks=tmp_path / "masks").read("a.png", undistorter)
    camera = undistorter.camera
    assert picture.mask.shape == (camera.height, camera.width)
    # The centre column is the principal point: the half stays a half under any radial distortion.
    column = np.arange(camera.width) + 0.5
    sure = np.abs(column - camera.cx) > 1.0
    inside = undistorter.image(painted)[1]
    expected = np.broadcast_to(column < camera.cx, picture.mask.shape)
    expected = expected if inside is None else expected & inside
    np.testing.assert_array_equal(picture.mask[:, sure], expected[:, sure])
    assert np.abs(picture.image[picture.mask] - np.array(COLOUR) / 255).max() < 0.005


def test_a_colour_stands_for_nothing_and_joins_the_masks(images: Path, tmp_path: Path) -> None:
    image = np.full((HEIGHT, WIDTH, 3), COLOUR, np.uint8)
    image[:10] = (255, 0, 255)
    image[10:20] = (252, 3, 255)
    write(images / "a.png", image)
    rows = np.arange(HEIGHT)[:, None]
    for tolerance, first in ((0, 10), (2, 10), (3, 20)):
        source = {"mask_colour": (255, 0, 255), "mask_tolerance": tolerance}
        picture = reader(images, **source).read("a.png", Undistorter(PINHOLE))
        np.testing.assert_array_equal(picture.mask, np.broadcast_to(rows >= first, picture.mask.shape))
    write(tmp_path / "masks/a.png", half_mask())
    picture = reader(images, masks=tmp_path / "masks", **source).read("a.png", Undistorter(PINHOLE))
    np.testing.assert_array_equal(picture.mask, (rows >= 20) & (half_mask() > 0))


def gradient() -> np.ndarray:
    """Alpha from 0 on the left to 255 on the right."""
    return np.tile(np.rint(np.linspace(0, 255, WIDTH)).astype(np.uint8), (HEIGHT, 1))


def transparent(path: Path, alpha: np.ndarray, colour: int = 90) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    options = {"lossless": True, "exact": True} if path.suffix == ".webp" else {}
    rgb = np.full((HEIGHT, WIDTH, 3), colour, np.uint8)
    Image.fromarray(np.dstack([rgb, alpha])).save(path, **options)


@pytest.mark.parametrize("suffix", [".png", ".webp", ".tif"])
def test_alpha_below_half_is_masked_and_joins_the_masks(tmp_path: Path, suffix: str) -> None:
    transparent(tmp_path / f"images/a{suffix}", gradient())
    picture = reader(tmp_path / "images").read(f"a{suffix}", Undistorter(PINHOLE))
    np.testing.assert_array_equal(picture.mask, gradient() >= 128)
    np.testing.assert_allclose(picture.image[gradient() == 255], 90 / 255, atol=1e-6)
    write(tmp_path / "masks/a.png", half_mask())
    both = reader(tmp_path / "images", masks=tmp_path / "masks").read(f"a{suffix}", Undistorter(PINHOLE))
    np.testing.assert_array_equal(both.mask, (gradient() >= 128) & (half_mask() > 0))


@pytest.mark.parametrize("alpha", [0, 255])
def test_alpha_that_says_nothing_masks_nothing(tmp_path: Path, alpha: int) -> None:
    transparent(tmp_path / "images/a.png", np.full((HEIGHT, WIDTH), alpha, np.uint8))
    assert reader(tmp_path / "images").read("a.png", Undistorter(PINHOLE)).mask is None


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("white", [1, 3, 200])
def test_the_brightest_value_of_the_masks_is_white(images: Path, tmp_path: Path, dtype: type, white: int) -> None:
    write(images / "b.png", np.full((HEIGHT, WIDTH, 3), COLOUR, np.uint8))
    write(tmp_path / "masks/a.png", np.zeros((HEIGHT, WIDTH), dtype))
    write(tmp_path / "masks/b.png", (half_mask() > 0).astype(dtype) * dtype(white))
    masked = reader(images, masks=tmp_path / "masks")
    assert not masked.read("a.png", Undistorter(PINHOLE)).mask.any()
    np.testing.assert_array_equal(masked.read("b.png", Undistorter(PINHOLE)).mask, half_mask() > 0)


@pytest.mark.parametrize("colour", [0, 255])
def test_a_mask_may_lie_in_its_alpha(images: Path, tmp_path: Path, colour: int) -> None:
    transparent(tmp_path / "masks/a.png", gradient(), colour)
    picture = reader(images, masks=tmp_path / "masks").read("a.png", Undistorter(PINHOLE))
    np.testing.assert_array_equal(picture.mask, gradient() >= 128)


def test_masks_that_are_all_black_are_refused_at_the_start(images: Path, tmp_path: Path) -> None:
    write(tmp_path / "masks/a.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(InputError):
        reader(images, masks=tmp_path / "masks").require_fitting([("a.png", Undistorter(PINHOLE))])


# ---- vignette --------------------------------------------------------------------------------------------------


def smooth_vignette(width: int, height: int) -> np.ndarray:
    """(H, W, 3) in (0, 1]: one in the middle, different in every channel towards the corners."""
    x, y = (np.arange(width) + 0.5) / width * 2 - 1, (np.arange(height) + 0.5) / height * 2 - 1
    r2 = x**2 + y[:, None] ** 2
    return np.stack([1 - loss * r2 for loss in (0.2, 0.3, 0.4)], axis=-1)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (2 * WIDTH, 2 * HEIGHT), (WIDTH // 2, HEIGHT // 2)])
@pytest.mark.parametrize("distortion", [Distortion(), LENS])
def test_a_vignette_is_that_of_the_delivered_image(
    images: Path, tmp_path: Path, bits: int, size: tuple[int, int], distortion: Distortion
) -> None:
    """A white wall seen through the lens: the delivered image over the delivered vignette is white again."""
    wall = np.round(255 * smooth_vignette(WIDTH, HEIGHT)).astype(np.uint8)
    write(images / "a.png", wall)
    # Not normalised: the brightest pixel is at three quarters of the range.
    peak = 0.75 * (2**bits - 1)
    write(tmp_path / "v.png", np.round(peak * smooth_vignette(*size)).astype(f"uint{bits}"))
    undistorter = Undistorter(PINHOLE, distortion, 0.5)
    picture = reader(images, vignette=tmp_path / "v.png").read("a.png", undistorter)
    assert picture.vignette.shape == picture.image.shape
    valid = np.ones(picture.image.shape[:2], bool) if picture.mask is None else picture.mask
    np.testing.assert_allclose((picture.image / picture.vignette)[valid], 1.0, atol=0.02)


def test_a_grey_vignette_serves_all_channels_and_where_it_is_black_pixels_do_not_count(
    images: Path, tmp_path: Path
) -> None:
    grey = np.full((HEIGHT, WIDTH), 200, np.uint8)
    grey[:, :10], grey[:, 10:20] = 0, 100
    write(tmp_path / "v.png", grey)
    source = reader(images, vignette=tmp_path / "v.png")
    picture = source.read("a.png", Undistorter(PINHOLE))
    np.testing.assert_array_equal(picture.mask, grey > 0)
    np.testing.assert_allclose(picture.vignette[:, 10:20], 0.5)
    np.testing.assert_allclose(picture.vignette[:, 20:], 1.0)
    assert picture.vignette.min() > 0


def test_masks_and_vignettes_that_cannot_be_used_are_refused_before_anything_is_decoded(
    images: Path, tmp_path: Path
) -> None:
    frames = [("a.png", Undistorter(PINHOLE))]
    write(tmp_path / "others/b.png", half_mask())
    write(tmp_path / "small/a.png", half_mask()[:, :-2])
    write(tmp_path / "square.png", np.full((HEIGHT, HEIGHT), 9, np.uint8))
    write(tmp_path / "black.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    (tmp_path / "text.png").write_bytes(b"no image")
    for setting, names in {
        "masks": ["others", "small", "none"],
        "vignette": ["square.png", "black.png", "text.png", "none.png"],
    }.items():
        for name in names:
            with pytest.raises(InputError, match=name):
                reader(images, **{setting: tmp_path / name}).require_fitting(frames)
