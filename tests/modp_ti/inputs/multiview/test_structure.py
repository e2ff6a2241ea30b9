"""Structure from motion on made features of a cloud of points, against the poses that they were seen from."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import camera_centres, exp_se3
from modp_ti.inputs.multiview.appearance import ALL_PAIRS, image_pairs
from modp_ti.inputs.multiview.features import Features
from modp_ti.inputs.multiview.structure import MatchedImage, reconstructed
from modp_ti.inputs.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.inputs.sources.undistortion import Intrinsics
from modp_ti.outputs.evaluation import umeyama
from tests.spread import disturbed

CAMERA = PinholeCamera(500.0, 500.0, 320.0, 240.0, 640, 480)
LENS = Distortion(numerator=(-0.1, 0.02))
COUNT = 8


def descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    raw = rng.integers(0, 120, (count, 128)).astype(float)
    return np.clip(np.floor(512 * np.sqrt(raw / raw.sum(axis=1, keepdims=True))), 0, 255).astype(np.uint8)


def poses() -> list[np.ndarray]:
    return [exp_se3([1.4 - 0.4 * i, 0.1 * np.sin(i), 0.05 * i, 0, 0.03 * i, 0]) for i in range(COUNT)]


def images(intrinsics: Intrinsics, known: bool, lens: Distortion = NO_DISTORTION) -> list[MatchedImage]:
    """Views of 400 points, with 0.3 px of noise."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform([-2, -2, 3], [2, 2, 6], (400, 3))
    described = descriptors(rng, len(xyz))
    made = []
    for i, T in enumerate(poses()):
        p = xyz @ T[:3, :3].T + T[:3, 3]
        pixels = lens.distort(p[:, :2] / p[:, 2:]) * CAMERA.fx + [CAMERA.cx, CAMERA.cy]
        seen = CAMERA.contains(pixels)
        pixels = disturbed(pixels[seen] + rng.normal(0, 0.3, (seen.sum(), 2)))
        made.append(MatchedImage(f"view {i}.png", Features(pixels, described[seen], 1.0), intrinsics, known))
    return made


ALL = [(i, j) for i in range(COUNT) for j in range(i + 1, COUNT)]


def silent(what: str, done: int, total: int) -> None:
    assert 0 <= done <= total and what


def off(model, truth: list[np.ndarray]) -> float:
    """Largest distance of a camera centre from the truth, after alignment by a similarity."""
    by_name = {
        image.name: np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in model.images.values()
    }
    source = camera_centres([by_name[f"view {i}.png"] for i in range(COUNT)])
    target = camera_centres(truth)
    s, R, t = umeyama(source, target)
    return float(np.linalg.norm(s * source @ R.T + t - target, axis=1).max())


@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_the_poses_and_the_camera_are_found(mapper: Literal["incremental", "global"]) -> None:
    guess = Intrinsics(PinholeCamera(544.0, 544.0, 320.0, 240.0, 640, 480))
    model = reconstructed(images(guess, known=False), ALL, mapper, 0, silent)
    assert model is not None and model.num_reg_images() == COUNT
    (camera,) = model.cameras.values()
    assert camera.params[0] == pytest.approx(500.0, rel=0.02)
    assert off(model, poses()) < 0.02


def test_a_known_camera_stays_as_it_is() -> None:
    intrinsics = Intrinsics(CAMERA, LENS)
    model = reconstructed(images(intrinsics, True, LENS), ALL, "incremental", 0, silent)
    assert model is not None and off(model, poses()) < 0.02
    (camera,) = model.cameras.values()
    np.testing.assert_array_equal(camera.params, [500, 500, 320, 240, -0.1, 0.02, 0, 0, 0, 0, 0, 0])


def test_two_runs_are_the_same() -> None:
    first, second = (reconstructed(images(Intrinsics(CAMERA), True), ALL, "incremental", 0, silent) for _ in range(2))
    assert first is not None and second is not None
    for number, image in first.images.items():
        there = second.images[number].cam_from_world().matrix()
        np.testing.assert_array_equal(image.cam_from_world().matrix(), there)


def test_images_of_nothing_in_common_give_no_model() -> None:
    rng = np.random.default_rng(1)
    other = [
        MatchedImage(
            image.name,
            Features(image.features.pixels, descriptors(rng, len(image.features.pixels)), 1.0),
            image.intrinsics,
            True,
        )
        for image in images(Intrinsics(CAMERA), True)
    ]
    assert reconstructed(other, ALL, "incremental", 0, silent) is None


def walk_that_comes_home(count: int) -> list[Features]:
    """Images of a hundred words each, of which neighbours share most, and the end is where the start was."""
    words = descriptors(np.random.default_rng(2), 10 * count)
    shown = [np.arange(10 * i, 10 * i + 100) % (10 * count - 100) for i in range(count)]
    return [Features(np.zeros((100, 2)), words[which], 1.0) for which in shown]


def test_a_sequence_is_matched_with_its_neighbours_and_where_it_comes_home() -> None:
    count = 2 * ALL_PAIRS
    pairs = image_pairs(walk_that_comes_home(count), 5, 0)
    assert pairs == sorted(set(pairs)) and all(i < j for i, j in pairs)
    assert {(i, i + step) for i in range(count - 5) for step in range(1, 6)} <= set(pairs)
    assert {(0, 64), (3, 35)} <= set(pairs)
    # The last ten images show what the first ten do.
    home = {(i, count - 10 + i) for i in range(5)}
    assert len(home & set(pairs)) >= 4
    assert len(pairs) < count * 25


def test_images_in_no_order_are_matched_with_those_that_look_alike() -> None:
    count = 2 * ALL_PAIRS
    features = walk_that_comes_home(count)
    order = np.random.default_rng(3).permutation(count)
    pairs = set(image_pairs([features[i] for i in order], None, 0))
    place = np.argsort(order)
    neighbours = [tuple(sorted((int(place[i]), int(place[i + 1])))) for i in range(count - 1)]
    assert sum(pair in pairs for pair in neighbours) > 0.95 * len(neighbours)
