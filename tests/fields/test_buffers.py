"""Buffers of images on the host and on the device."""

from __future__ import annotations

import gc

import numpy as np
import pytest

from fields.buffers.images import PAD, DeviceImages, ImageBuffers
from fields.runtime.engine import ti


@pytest.fixture(scope="module")
def images(taichi_on_the_cpu: None) -> ImageBuffers:
    """Up to 40x20 pixels."""
    builder = ti.FieldsBuilder()
    buffers = ImageBuffers(builder, 40, 20)
    builder.finalize()
    return buffers


def rgba(width: int, height: int, seed: int = 0) -> np.ndarray:
    image = np.random.default_rng(seed).integers(0, 256, (height, width, 4), dtype=np.uint8)
    image[..., 3] = np.where(image[..., 3] > 60, 255, 0)
    return image


def plane(images: ImageBuffers, buffer: ti.Field, channel: int) -> np.ndarray:
    """A plane with its border, (rows, stride)."""
    return buffer.to_numpy()[channel * images.plane : (channel + 1) * images.plane].reshape(-1, images.stride)


@pytest.mark.parametrize("size", [(40, 20), (17, 9), (1, 1)])
def test_images_lie_in_planes_with_a_border_of_zeros(images: ImageBuffers, size: tuple[int, int]) -> None:
    width, height = size
    images.resize(40, 20)
    images.set_reference(rgba(40, 20, seed=1))  # nothing of a larger image may stay
    images.resize(3, 2)
    images.resize(width, height)
    image = rgba(width, height)
    images.set_reference(image)
    inside = (slice(PAD, PAD + height), slice(PAD, PAD + width))
    for channel in range(3):
        values = plane(images, images.reference, channel)
        np.testing.assert_allclose(values[inside], image[..., channel] / 255, rtol=1e-6)
        values[inside] = 0
        assert (values == 0).all()
    np.testing.assert_array_equal(plane(images, images.valid, 0)[inside], image[..., 3] / 255)


def test_gradients_are_taken_in_and_read_back(images: ImageBuffers) -> None:
    images.resize(23, 11)
    rng = np.random.default_rng(2)
    colour, depth, opacity = rng.normal(size=(11, 23, 3)), rng.normal(size=(11, 23)), rng.normal(size=(11, 23))
    images.set_gradients(colour, depth, opacity)
    np.testing.assert_array_equal(images.colour_gradient_to_numpy(), colour.astype(np.float32))
    inside = (slice(PAD, PAD + 11), slice(PAD, PAD + 23))
    np.testing.assert_array_equal(plane(images, images.depth_grad, 0)[inside], depth.astype(np.float32))
    np.testing.assert_array_equal(plane(images, images.opacity_grad, 0)[inside], opacity.astype(np.float32))


def test_clipping_brings_the_render_into_the_range_of_a_file(images: ImageBuffers) -> None:
    images.resize(7, 5)
    colour = np.random.default_rng(3).normal(0.5, 1.0, (5, 7, 3)).astype(np.float32)
    images.set_gradients(colour, np.zeros((5, 7)), np.zeros((5, 7)))
    images.colour.copy_from(images.colour_grad)
    images.clip_colour()
    np.testing.assert_array_equal(images.colour_to_numpy(), np.clip(colour, 0, 1))


@pytest.mark.parametrize("size", [(41, 20), (40, 21)])
def test_images_beyond_the_capacity_are_refused(images: ImageBuffers, size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=f"{size[0]}x{size[1]}"):
        images.resize(*size)


def image(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (10, 10, 4)).astype(np.uint8)


def test_a_copy_is_made_once_and_is_the_image() -> None:
    images, one = DeviceImages(1000), image(1)
    copy = images.of(one)
    np.testing.assert_array_equal(copy.cpu().numpy(), one)
    assert images.of(one) is copy
    assert images.bytes == one.nbytes


def test_the_least_recently_used_leaves_first() -> None:
    images, every = DeviceImages(1000), [image(i) for i in range(4)]
    for i in (0, 1, 0, 2):
        images.of(every[i])
    assert [one in images for one in every] == [True, False, True, False]
    images.of(every[3])
    assert [one in images for one in every] == [False, False, True, True]
    assert images.bytes == 800


def test_a_copy_goes_with_its_image() -> None:
    images, kept = DeviceImages(10_000), image(0)
    images.of(kept)
    for seed in range(1, 5):
        passing = image(seed)
        np.testing.assert_array_equal(images.of(passing).cpu().numpy(), passing)
        del passing
        gc.collect()
    assert len(images) == 1
    assert images.bytes == kept.nbytes
