"""Undistorted images show the world as the pinhole camera of the same name would, at any scale."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest

from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.sources import Distortion, Undistorter
from modp_ti.inputs.sources.distortion import colmap_intrinsics

CAMERAS = {
    "PINHOLE": [500, 510, 318.2, 243.1],
    "SIMPLE_RADIAL": [500, 318.2, 243.1, -0.11],
    "OPENCV": [480, 470, 318.2, 243.1, 0.12, -0.08, 0.004, -0.003],
    "OPENCV_FISHEYE": [320, 330, 318.2, 243.1, -0.02, 0.01, -0.004, 0.0006],
}
WIDTH, HEIGHT = 640, 481


def made(model: str, scale: float) -> tuple[Undistorter, pycolmap.Camera]:
    fx, fy, cx, cy, distortion = colmap_intrinsics(model, CAMERAS[model])
    oracle = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=CAMERAS[model])
    return Undistorter(PinholeCamera(fx, fy, cx, cy, WIDTH, HEIGHT), distortion, scale), oracle


def scene_colour(ideal: np.ndarray) -> np.ndarray:
    """A smooth picture (..., 3) in [0, 1] on the plane of ideal coordinates (..., 2)."""
    x, y = ideal[..., 0], ideal[..., 1]
    waves = np.stack([np.sin(9 * x + 2 * y), np.sin(7 * y - 3 * x), np.sin(5 * x + 6 * y + 1)], axis=-1)
    return 0.5 + 0.45 * waves


def photograph(oracle: pycolmap.Camera) -> np.ndarray:
    """What the distorting camera sees, computed per pixel with pycolmap's inverse model."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    ideal = oracle.cam_from_img(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(HEIGHT, WIDTH, 2)
    return np.round(255 * scene_colour(ideal)).astype(np.uint8)


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.37])
@pytest.mark.parametrize("model", CAMERAS)
def test_image_is_that_of_the_pinhole_camera(model, scale):
    undistorter, oracle = made(model, scale)
    image, mask = undistorter.image(photograph(oracle))
    camera = undistorter.camera
    assert image.dtype == np.float32
    assert image.shape == (camera.height, camera.width, 3)
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    expected = scene_colour(np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=-1))
    valid = np.ones(u.shape, bool) if mask is None else mask
    inner = cv2.erode(np.pad(valid, 1).astype(np.uint8), np.ones((5, 5)))[1:-1, 1:-1] > 0
    # A shift of half a pixel would change the picture by up to 0.03 / scale in places.
    error = np.abs(image - expected)[inner]
    assert error.mean() < 0.003
    assert np.percentile(error, 99.9) < 0.012


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"])
def test_mask_holds_exactly_the_pixels_that_the_photograph_covers(model):
    undistorter, oracle = made(model, 0.5)
    _, mask = undistorter.image(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    camera = undistorter.camera
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    ideal = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1), np.ones(u.size))
    raw = oracle.img_from_cam(ideal)
    covered = ((raw >= 0) & (raw < (WIDTH, HEIGHT))).all(axis=1).reshape(u.shape)
    if covered.all():
        assert mask is None
    else:
        # the scaled size is rounded to whole pixels: the border may differ by the rounding of one comparison
        assert (mask != covered).sum() <= 2
        assert not mask.flags.writeable


def test_pixels_beyond_the_fold_of_a_lens_polynomial_are_masked():
    undistorter = Undistorter(PinholeCamera(200, 200, 200, 150, 400, 300), Distortion((-0.3,)))
    _, mask = undistorter.image(np.zeros((300, 400, 3), np.uint8))
    u, v = np.meshgrid(np.arange(400) + 0.5, np.arange(300) + 0.5)
    radius = np.hypot(u - 200, v - 150) / 200
    assert not mask[radius > 1 / np.sqrt(0.9) + 0.01].any()
    assert mask[radius < 1 / np.sqrt(0.9) - 0.01].all()


def test_nothing_to_do_gives_the_stored_pixels():
    raw = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    camera = PinholeCamera(50, 51, 30, 25, 64, 48)
    undistorter = Undistorter(camera)
    image, mask = undistorter.image(raw)
    assert undistorter.camera == camera
    assert np.array_equal(np.round(image * 255).astype(np.uint8), raw)
    assert mask is None
    pixels = np.array([[0.0, 0.0], [31.3, 7.7]])
    assert np.array_equal(undistorter.points(pixels), pixels)


def test_each_axis_follows_its_exact_ratio():
    camera = Undistorter(PinholeCamera(1000, 1001, 540, 960, 1080, 1921), scale=0.25).camera
    assert (camera.width, camera.height) == (270, 480)
    assert camera.fx == pytest.approx(250.0)
    assert camera.fy == pytest.approx(1001 * 480 / 1921)
    assert camera.cy == pytest.approx(960 * 480 / 1921)
    assert Undistorter(camera, scale=0.0001).camera.width == 1


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV"])
def test_an_image_of_a_guessed_camera_becomes_that_of_the_camera_that_is_found(model):
    found, oracle = made(model, 0.5)
    guess = Undistorter(PinholeCamera(540.0, 540.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT), scale=0.5)
    revision = found.revising(guess)
    photo = photograph(oracle)
    (seen, _), (wanted, mask) = guess.image(photo), found.image(photo)
    rgba = np.dstack([np.round(255 * seen), np.full(seen.shape[:2], 255.0)]).astype(np.uint8)
    got = revision.image(rgba)
    valid = (got[..., 3] > 0) & (True if mask is None else mask)
    assert valid.mean() > 0.9
    inner = cv2.erode(np.pad(valid, 1).astype(np.uint8), np.ones((5, 5)))[1:-1, 1:-1] > 0
    error = np.abs(got[..., :3] / 255.0 - wanted)[inner]
    assert error.mean() < 0.004 and np.percentile(error, 99) < 0.02
    assert revision.camera == found.camera
    raw = np.random.default_rng(0).uniform([40, 40], [WIDTH - 40, HEIGHT - 40], (500, 2))
    np.testing.assert_allclose(revision.pixels(guess.points(raw)), found.points(raw), atol=0.05)
