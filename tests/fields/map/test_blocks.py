from __future__ import annotations

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3
from fields.map.blocks import Boxes, box_of, divide, extent_of, planes_of, seen

CAMERA = PinholeCamera(60.0, 50.0, 30.0, 25.0, 64, 48)


@pytest.fixture
def spheres() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.normal(0.0, 3.0, (400, 3)), np.exp(rng.normal(-3.0, 1.5, 400))


def test_every_sphere_is_in_one_block_and_in_its_box(spheres: tuple[np.ndarray, np.ndarray]) -> None:
    position, extent = spheres
    blocks = divide(position, extent, 1.0)
    assert sorted(blocks.members.tolist()) == list(range(400))
    assert blocks.counts.sum() == 400 and (blocks.counts > 0).all()
    for block in range(len(blocks)):
        of = blocks.of(block)
        assert (np.diff(of) > 0).all()
        np.testing.assert_array_equal(blocks.boxes.low[block], (position[of] - extent[of, None]).min(axis=0))
        np.testing.assert_array_equal(blocks.boxes.high[block], (position[of] + extent[of, None]).max(axis=0))


def test_spheres_share_a_block_if_cube_and_size_class_agree(spheres: tuple[np.ndarray, np.ndarray]) -> None:
    position, extent = spheres
    blocks = divide(position, extent, 1.0)
    of = np.empty(400, dtype=int)
    for block in range(len(blocks)):
        of[blocks.of(block)] = block

    def key(i: int) -> tuple:
        side = 1.0
        while extent[i] > side / 4:
            side *= 2
        return (side, *np.floor(position[i] / side))

    keys = [key(i) for i in range(400)]
    for i in range(400):
        assert (of == of[i]).tolist() == [other == keys[i] for other in keys]


def test_no_box_reaches_farther_than_a_quarter_beyond_its_cube(spheres: tuple[np.ndarray, np.ndarray]) -> None:
    position, extent = spheres
    boxes = divide(position, np.minimum(extent, 0.25), 1.0).boxes
    assert (boxes.high - boxes.low <= 1.5 + 1e-9).all()


def test_nothing_is_divided_into_nothing() -> None:
    blocks = divide(np.zeros((0, 3)), np.zeros(0), 1.0)
    assert len(blocks) == 0 and blocks.counts.tolist() == []


def test_what_a_view_draws_of_a_box_is_seen(spheres: tuple[np.ndarray, np.ndarray]) -> None:
    position, extent = spheres
    boxes = Boxes(position - extent[:, None], position + extent[:, None])
    poses = [exp_se3(np.random.default_rng(i).normal(0.0, 1.0, 6)) for i in range(12)]
    found = seen(np.array([planes_of(CAMERA, T, 6.0) for T in poses]), boxes)
    # Points inside the boxes, projected one by one.
    inside = boxes.low + np.random.default_rng(1).uniform(0.0, 1.0, (50, 400, 3)) * (boxes.high - boxes.low)
    for T, flags in zip(poses, found, strict=True):
        p = inside.reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
        shown = (p[:, 2] > 0) & (p[:, 2] < 6.0)
        shown[shown] = CAMERA.contains(CAMERA.project(p[shown]))
        assert not (shown.reshape(50, 400).any(axis=0) & ~flags).any()
        assert flags.mean() < 0.6  # most of the world is beside the image, behind the camera or too far


def test_boxes_behind_beside_and_too_far_are_not_seen() -> None:
    centre = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [9.0, 0.0, 2.0], [0.0, -9.0, 2.0], [0.0, 0.0, 20.0]])
    boxes = Boxes(centre - 0.1, centre + 0.1)
    assert seen(planes_of(CAMERA, np.eye(4), 5.0)[None], boxes).tolist() == [[True, False, False, False, False]]
    assert seen(planes_of(CAMERA, np.eye(4), np.inf)[None], boxes)[0, 4]


def test_distances_are_to_the_nearest_point_of_a_box() -> None:
    boxes = Boxes(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]), np.array([[1.0, 1.0, 1.0], [2.0, 2.0, 1.0]]))
    np.testing.assert_allclose(boxes.distance(np.array([0.5, 0.5, 0.5])), [0.0, np.hypot(0.5, 0.5)])


def test_the_extent_of_a_gaussian_is_three_of_its_largest_standard_deviations() -> None:
    np.testing.assert_allclose(extent_of(np.log([[0.1, 0.3, 0.2]])), [0.9])
    box = box_of(np.array([[1.0, 0.0, 0.0]]), np.array([0.9]))
    np.testing.assert_allclose([box.low[0], box.high[0]], [[0.1, -0.9, -0.9], [1.9, 0.9, 0.9]])
