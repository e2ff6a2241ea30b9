"""Space is free where a camera saw or went, solid at surfaces, unknown elsewhere: against the room's true surface."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from fields.geometry.se3 import camera_centres
from pipelines.surface.free_space import FREE, SOLID, UNKNOWN, VoxelSpace, carved, reached, walkable
from tests.room import HIGH, LOW, Room, look_at, pinhole

VOXEL = 0.1
TURN = np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])


def looking_around(count: int = 24) -> NDArray[np.float64]:
    """T_camera_world (N, 4, 4) of a camera that walks and turns in the room, and looks up and down."""
    t = np.linspace(0.0, 1.0, count)
    eyes = np.stack([-1.6 + 3.2 * t, -1.2 + 0.2 * np.sin(9 * t), 1.3 + 0.1 * np.sin(7 * t)], axis=1)
    ahead = np.stack([np.cos(17 * t), np.sin(17 * t), 0.7 * np.sin(29 * t) - 0.3], axis=1)
    return np.stack([look_at(eye, eye + way) for eye, way in zip(eyes, ahead, strict=True)])


def true_views(room: Room, poses: NDArray[np.float64]) -> list:
    camera = pinhole(160, 120)
    pixels = np.stack(np.meshgrid(np.arange(160), np.arange(120)), axis=2).reshape(-1, 2) + 0.5
    return [(camera, T, room.depth(camera, T, pixels).reshape(120, 160).astype(np.float32)) for T in poses]


@pytest.fixture(scope="module")
def space(room: Room) -> VoxelSpace:
    poses = looking_around()
    return carved(true_views(room, poses), [camera_centres(poses)], TURN, VOXEL, 10.0)


def centres_of(space: VoxelSpace, state: int) -> NDArray[np.float64]:
    return VOXEL * (np.argwhere(space.state == state) + space.first + 0.5) @ TURN


def before_surface(room: Room, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far (N,) before a surface the camera sees points (N, 3) that sees farthest past them; negative is behind."""
    best = np.full(len(points), -np.inf)
    for eye in camera_centres(looking_around()):
        rays = points - eye
        best = np.maximum(best, (room.cast(eye, rays)[0] - 1.0) * np.linalg.norm(rays, axis=1))
    return best


def from_surface(room: Room, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance (N,) of points (N, 3) from a cloud of what random rays from the cameras hit."""
    rng, hit = np.random.default_rng(1), []
    for eye in camera_centres(looking_around()):
        rays = rng.normal(size=(10_000, 3))
        hit.append(eye + room.cast(eye, rays)[0][:, None] * rays)
    return cKDTree(np.concatenate(hit)).query(points)[0]


def test_what_is_free_lies_before_the_surface_and_what_is_solid_at_it(room: Room, space: VoxelSpace) -> None:
    free, solid = centres_of(space, FREE), centres_of(space, SOLID)
    assert min(len(free), len(solid)) > 1000
    assert (before_surface(room, free) > -VOXEL).mean() > 0.999  # by rounding to voxels
    assert from_surface(room, solid).max() < 1.2 * VOXEL  # half a voxel's diagonal
    assert space.state.shape[2] < 26 + 15  # the room, and not much more


def test_what_no_camera_saw_is_unknown(room: Room, space: VoxelSpace) -> None:
    every = VOXEL * (np.argwhere(space.state >= 0) + space.first + 0.5) @ TURN
    behind = np.flatnonzero(before_surface(room, every) < -VOXEL)[::9]
    behind = behind[from_surface(room, every[behind]) > 2 * VOXEL]
    assert len(behind) > 1000
    assert (space.state.reshape(-1)[behind] == UNKNOWN).all()


def test_what_the_cameras_saw_is_known(room: Room, space: VoxelSpace) -> None:
    camera, seen = pinhole(160, 120), []
    for T in looking_around():
        pixels = np.random.default_rng(3).uniform([4, 4], [156, 116], (200, 2))
        z = room.depth(camera, T, pixels)
        for share, expected in ((0.5, FREE), (1.0, SOLID)):
            points = (camera.unproject(pixels, share * z) - T[:3, 3]) @ T[:3, :3]
            seen.append((expected, space.at(points)))
    for expected, least in ((FREE, 0.99), (SOLID, 0.9)):
        states = np.concatenate([states for kind, states in seen if kind == expected])
        assert (states == expected).mean() > least


def test_the_way_of_a_camera_is_free_by_definition_and_nothing_else_that_is_unseen() -> None:
    way = np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 0.3], [2.0, -1.0, 0.3]])
    wall = np.full((120, 160), 1.0, np.float32)  # in the way
    space = carved([(pinhole(160, 120), np.eye(4), wall)] * 4, [way], np.eye(3), VOXEL, 10.0)
    share = np.linspace(0.0, 1.0, 99)[:, None]
    for a, b in pairwise(way):
        assert (space.at(a + share * (b - a)) == FREE).all()
    assert (space.at(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.3], [-9.0, 0.0, 0.0]])) == [SOLID, UNKNOWN, UNKNOWN]).all()


@pytest.mark.parametrize("share", [0.4, 0.7])
def test_what_is_reached_is_one_connected_part(share: float) -> None:
    state = (np.random.default_rng(8).uniform(size=(17, 23, 11)) < share).astype(np.uint8)
    state[3, 4, 5] = FREE
    space = VoxelSpace(state, VOXEL, np.array([-5, 7, 0]), TURN)
    start = VOXEL * (np.array([[3, 4, 5]]) + space.first + 0.5) @ TURN
    labels, _ = ndimage.label(state == FREE)
    np.testing.assert_array_equal(reached(space, start), labels == labels[3, 4, 5])


def test_the_floor_of_the_room_is_found(space: VoxelSpace) -> None:
    assert space.floor(1.3) == pytest.approx(0.0, abs=1.01 * VOXEL)
    assert space.floor(-1.0) is None


def test_a_floor_is_below_a_larger_table() -> None:
    state = np.full((40, 40, 30), FREE, np.uint8)
    state[:, :, 12] = SOLID  # seen from above
    state[:, :18, 12], state[:, :18, 5] = FREE, SOLID
    for tilt in (0, 1):  # a floor may fill parts of two layers
        state[: 20 * tilt, :18, 5], state[: 20 * tilt, :18, 4] = FREE, SOLID
        space = VoxelSpace(state, VOXEL, np.array([3, -4, -2]), TURN)
        assert space.floor(2.0) == pytest.approx(VOXEL * 3.5, abs=1.01 * VOXEL * tilt)


def test_one_may_walk_where_the_floor_was_not_seen_but_not_out_of_the_room(room: Room, space: VoxelSpace) -> None:
    way = camera_centres(looking_around())
    floor = space.floor(1.3)
    assert floor is not None
    there = VOXEL * (np.argwhere(walkable(space, way, floor)) + space.first + 0.5) @ TURN
    assert (np.abs(there - (LOW + HIGH) / 2) < (HIGH - LOW) / 2 + 1.2 * VOXEL)[:, :2].all()
    below = np.stack([way[:, 0], way[:, 1], np.full(len(way), 0.3)], axis=1)
    assert cKDTree(there).query(below)[0].max() < VOXEL
    # Of the floor around the furniture, nearly all can be reached.
    spots = np.stack(np.meshgrid(*(np.arange(LOW[k] + 0.3, HIGH[k] - 0.2, 0.1) for k in (0, 1)), [0.3]), axis=3)
    open_spots = spots.reshape(-1, 3)
    open_spots = open_spots[room.distance(open_spots) > 0.25]
    assert (cKDTree(there).query(open_spots)[0] < VOXEL).mean() > 0.9


def test_voxels_beyond_what_memory_holds_are_refused_before_they_are_made() -> None:
    way = np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 0.3]])
    with pytest.raises(ValueError, match="voxels"):
        carved([(pinhole(160, 120), np.eye(4), np.ones((120, 160), np.float32))], [way], np.eye(3), 1e-9, 10.0)
