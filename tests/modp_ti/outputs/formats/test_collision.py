"""Voxels for robots and games: other readers find them again, and nothing leaves the mesh."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
import yaml
from scipy import ndimage
from skimage.graph import route_through_array

from fields.geometry.se3 import camera_centres
from modp_ti.outputs.formats.collision import boundary, write_octomap, write_ros_map, write_voxels
from modp_ti.outputs.formats.mesh import open3d, write_mesh
from pipelines.surface.free_space import FREE, SOLID, UNKNOWN, VoxelSpace, carved, reached
from tests.pipelines.surface.test_free_space import looking_around, true_views
from tests.room import HIGH, LOW, Room

TURN = np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])


@pytest.fixture
def space() -> VoxelSpace:
    state = np.random.default_rng(6).choice(3, (19, 13, 24)).astype(np.uint8)
    state[:8, :8, 8:24] = FREE  # larger leaves
    return VoxelSpace(state, 0.25, np.array([-11, 3, -7]), TURN)


def read_octomap(path: Path) -> tuple[float, int, dict[tuple[int, int, int], int]]:
    """Edge, number of nodes and states by key of an OctoMap's `.bt`, node after node, as OctoMap reads it."""
    head, _, body = path.read_bytes().partition(b"data\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["# Octomap OcTree binary file", "id OcTree"]
    values = dict(line.split() for line in lines[2:])
    states, at, nodes = {}, 0, 1

    def node(x: int, y: int, z: int, edge: int) -> None:
        nonlocal at, nodes
        (bits,) = struct.unpack_from("<H", body, at)
        at += 2
        half = edge // 2
        for child in range(8):
            kind = bits >> 2 * child & 3
            corner = x + half * (child & 1), y + half * (child >> 1 & 1), z + half * (child >> 2 & 1)
            nodes += kind != 0
            if kind in (1, 2):
                for step in np.ndindex(half, half, half):
                    states[corner[0] + step[0], corner[1] + step[1], corner[2] + step[2]] = kind
        for child in range(8):
            if bits >> 2 * child & 3 == 3:
                node(x + half * (child & 1), y + half * (child >> 1 & 1), z + half * (child >> 2 & 1), half)

    node(-(1 << 15), -(1 << 15), -(1 << 15), 1 << 16)
    assert at == len(body) and nodes == int(values["size"])
    return float(values["res"]), nodes, states


def test_an_octomap_holds_every_voxel_and_joins_eight_alike(tmp_path: Path, space: VoxelSpace) -> None:
    write_octomap(tmp_path / "map.bt", space)
    edge, _, states = read_octomap(tmp_path / "map.bt")
    assert edge == space.voxel
    known = np.argwhere(space.state != UNKNOWN)
    assert states == {tuple(map(int, i + space.first)): int(space.state[tuple(i)]) for i in known}
    alike = VoxelSpace(np.full((8, 8, 8), FREE, np.uint8), 0.25, np.array([-16, 8, 24]), TURN)
    write_octomap(tmp_path / "map.bt", alike)
    assert read_octomap(tmp_path / "map.bt")[1] == 1 + 13  # from the root down to one leaf


@pytest.mark.parametrize("height", [-9.0, -0.4, 1.3, 99.0])
def test_a_map_for_ros_is_the_slice_at_the_height(tmp_path: Path, space: VoxelSpace, height: float) -> None:
    write_ros_map(tmp_path, space, height)
    about = yaml.safe_load((tmp_path / "map.yaml").read_text())
    picture = cv2.imread(str(tmp_path / about["image"]), cv2.IMREAD_UNCHANGED)
    assert about["mode"] == "trinary" and about["negate"] == 0
    occupied = (255 - picture.astype(float)) / 255  # as map_server reads it, whose cells begin at the lower left
    states = np.where(
        occupied > about["occupied_thresh"], SOLID, np.where(occupied < about["free_thresh"], FREE, UNKNOWN)
    )[::-1]
    z = np.clip(height, space.voxel * space.first[2], space.voxel * (space.first[2] + space.state.shape[2] - 0.5))
    x, y = (about["origin"][axis] + about["resolution"] * (np.arange(states.shape[1 - axis]) + 0.5) for axis in (0, 1))
    points = np.stack([*(v.ravel() for v in np.meshgrid(x, y)), np.full(states.size, z)], axis=1)
    np.testing.assert_array_equal(space.at(points @ TURN).reshape(states.shape), states)


def test_the_archive_says_where_its_voxels_lie(tmp_path: Path, space: VoxelSpace) -> None:
    origin = np.array([5.0, -3.0, 2.0])
    write_voxels(tmp_path / "voxels.npz", space, origin, None)
    with np.load(tmp_path / "voxels.npz") as file:
        assert np.isnan(file["floor"])
        points = np.random.default_rng(1).uniform(-3, 3, (500, 3))
        grid = (points + origin) @ file["T_grid_world"][:3, :3].T + file["T_grid_world"][:3, 3]
        index = np.floor((grid - file["origin"]) / file["voxel"]).astype(int)
        inside = ((index >= 0) & (index < file["state"].shape)).all(axis=1)
        assert inside.sum() > 50
        np.testing.assert_array_equal(file["state"][tuple(index[inside].T)], space.at(points)[inside])


def test_the_mesh_is_closed_faces_inwards_and_is_light(tmp_path: Path, space: VoxelSpace) -> None:
    ball = np.linalg.norm(np.indices((40, 40, 40)) - 19.5, axis=0) < 19.9  # up to the sides of the grid
    place = VoxelSpace(ball.astype(np.uint8), 0.25, np.array([-4, 10, 3]), TURN)
    for most in (100_000, 2000):
        write_mesh(tmp_path / "mesh.glb", boundary(place, ball, most))
        mesh = trimesh.load(tmp_path / "mesh.glb", force="mesh")
        assert len(mesh.faces) <= most and mesh.is_watertight
        assert -mesh.volume == pytest.approx(0.25**3 * ball.sum(), rel=0.03)
        middle = 0.25 * (place.first + 20) @ TURN * [1, -1, -1]  # y is up in GLB
        np.testing.assert_allclose(mesh.bounds.mean(axis=0), middle, atol=0.1)


def test_nothing_leaves_the_room_and_its_walk_is_found(tmp_path: Path, room: Room) -> None:
    """A ball of 0.3 m that drops from 1,000 places of the camera, its way, and the way that a robot would plan."""
    poses = looking_around(60)
    way = camera_centres(poses)
    space = carved(true_views(room, poses), [way], TURN, 0.06, 10.0)
    mesh = boundary(space, reached(space, way))
    assert len(mesh.triangles) <= 20_000
    o3d = open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    tensor, radius = o3d.core.Tensor, 0.15
    steps = np.diff(way, axis=0)
    rays = np.concatenate([way[:-1], steps], axis=1).astype(np.float32)
    assert (scene.cast_rays(tensor(rays))["t_hit"].numpy() > 1.0).all(), "a wall in the way"
    rng = np.random.default_rng(2)
    places = way[rng.integers(len(steps), size=1000)] + 0.0
    clear = scene.compute_distance(tensor(places.astype(np.float32))).numpy()
    assert clear.min() > radius
    for _ in range(60):
        gap = scene.compute_distance(tensor(places.astype(np.float32))).numpy() - radius
        places[:, 2] -= np.clip(gap, 0.0, None)
    assert places[:, 2].min() - radius > -0.06  # the floor is at 0, to a voxel
    assert np.median(places[:, 2]) < 1.0  # and they have fallen
    write_ros_map(tmp_path, space, float(np.median(way[:, 2])))
    about = yaml.safe_load((tmp_path / "map.yaml").read_text())
    picture = cv2.imread(str(tmp_path / "map.pgm"), cv2.IMREAD_UNCHANGED)
    cost = np.where(ndimage.binary_dilation(picture != 254, iterations=2), -1.0, 1.0)  # a robot of 0.3 m
    cells = np.floor(((way @ TURN.T)[:, :2] - about["origin"][:2]) / about["resolution"]).astype(int)
    rows = np.stack([len(picture) - 1 - cells[:, 1], cells[:, 0]], axis=1)
    path, _ = route_through_array(cost, rows[0], rows[-1])
    assert (cost[tuple(np.transpose(path))] > 0).all()
    x, y = np.transpose(path)[::-1]
    places = np.stack([x + 0.5, len(picture) - 0.5 - y], axis=1) * about["resolution"] + about["origin"][:2]
    points = np.column_stack([places, np.full(len(path), np.median(way[:, 2]))]) @ TURN
    assert room.distance(points).min() > radius and ((points > LOW) & (points < HIGH)).all()
