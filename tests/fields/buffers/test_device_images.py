from __future__ import annotations

import gc

import numpy as np

from fields.buffers.images import DeviceImages


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


def test_an_image_larger_than_the_room_is_still_served_alone() -> None:
    images, every = DeviceImages(100), [image(i) for i in range(2)]
    for one in every:
        np.testing.assert_array_equal(images.of(one).cpu().numpy(), one)
    assert len(images) == 1


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
