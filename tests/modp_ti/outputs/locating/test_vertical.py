"""Down by vertical edges in pictures of the room in worlds turned by chance, and by directions in cameras."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modp_ti.outputs.locating.vertical import common_direction, edges, mean_direction
from tests.room import Room, pinhole, walk

CAMERA = pinhole(320, 240)


@pytest.mark.parametrize("seed", range(3))
def test_down_is_found_to_half_a_degree_in_a_world_turned_by_chance(room: Room, seed: int) -> None:
    rng, turned = np.random.default_rng(seed), np.eye(4)
    turned[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    poses = walk(9, 0.1)
    views = [edges(room.image(CAMERA, T), CAMERA, T @ turned.T) for T in poses]
    down = turned[:3, :3] @ [0.0, 0.0, -1.0]
    aside = np.cross(down, rng.normal(size=3))
    around = Rotation.from_rotvec(np.radians(20.0) * aside / np.linalg.norm(aside)).apply(down)
    found = common_direction(views, around)
    assert found is not None
    error = np.degrees(np.arccos(min(found[0] @ down, 1.0)))
    assert error < 0.5
    assert error < 3.0 * np.degrees(found[1])


def test_edges_of_all_directions_tell_nothing() -> None:
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(9, 200, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    views = [np.column_stack([normal, rng.uniform(10, 50, 200)]) for normal in normals]
    assert common_direction(views, np.array([0.0, 1.0, 0.0])) is None
    assert common_direction([np.zeros((0, 4))] * 3, np.array([0.0, 1.0, 0.0])) is None


def test_the_mean_of_a_direction_in_many_cameras_and_its_deviation() -> None:
    rng, down = np.random.default_rng(7), np.array([0.0, 0.6, 0.8])
    errors = []
    for seed in range(40):
        R = Rotation.random(200, random_state=seed).as_matrix()
        poses = np.tile(np.eye(4), (200, 1, 1))
        poses[:, :3, :3] = R
        mean, deviation = mean_direction(poses, R @ down + rng.normal(0.0, 0.02, (200, 3)), down) or (down, 0.0)
        errors.append(np.linalg.norm(mean - down) / deviation)
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.5
    assert mean_direction(poses, -R @ down, down) is None  # pictures that were turned
