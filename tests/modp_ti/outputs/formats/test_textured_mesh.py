"""A textured mesh shows, in other programs, the colours that pictures of it show."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from fields.geometry.camera import PinholeCamera
from modp_ti.outputs.formats.mesh import open3d
from modp_ti.outputs.formats.textured_mesh import TexturedMesh, painted, unwrapped, write_textured_mesh
from tests.room import look_at

pytest.importorskip("xatlas", reason="no wheel of xatlas for this Python")

CAMERA = PinholeCamera(130.0, 130.0, 80.0, 60.0, 160, 120)


@pytest.fixture(scope="module")
def cube() -> TexturedMesh:
    """A cube from 0 to 1 whose colour is the place, painted from pictures taken from outside its corners."""
    mesh = open3d().geometry.TriangleMesh.create_box().subdivide_midpoint(2)
    scene = open3d().t.geometry.RaycastingScene()
    scene.add_triangles(open3d().t.geometry.TriangleMesh.from_legacy(mesh))
    shots = []
    for eye in product((-1.0, 2.0), repeat=3):
        T = look_at(np.array(eye), np.array([0.5, 0.5, 0.5]))
        rays = scene.create_rays_pinhole(CAMERA.matrix(), T, 160, 120)
        t = scene.cast_rays(rays)["t_hit"].numpy()[..., None]
        places = rays.numpy()[..., :3] + t * rays.numpy()[..., 3:]
        shots.append((CAMERA, T, np.where(np.isfinite(t), np.clip(places, 0, 1), 0.0)))
    return painted(unwrapped(mesh, texture=256), shots)


def read_by_open3d(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners (T, 3, 3) of the triangles, their places (T, 3, 2) in the image from its lower left, and the image."""
    model = open3d().io.read_triangle_model(str(path))
    mesh, image = model.meshes[0].mesh, np.asarray(model.materials[model.meshes[0].material_idx].albedo_img)
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
    return corners, np.asarray(mesh.triangle_uvs).reshape(-1, 3, 2), image


def read_by_trimesh(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same."""
    mesh = trimesh.load_mesh(path)
    visual: Any = mesh.visual
    return mesh.vertices[mesh.faces], visual.uv[mesh.faces], np.asarray(visual.material.baseColorTexture)


@pytest.mark.parametrize("read", [read_by_open3d, read_by_trimesh])
def test_another_program_finds_the_colours_of_known_points(cube: TexturedMesh, tmp_path: Path, read) -> None:
    write_textured_mesh(tmp_path / "cube.glb", cube)
    corners, uv, image = read(tmp_path / "cube.glb")
    corners = corners * [1, -1, -1]  # y is up there
    height, width = image.shape[:2]
    inner = np.random.default_rng(0).dirichlet([2.0, 2.0, 2.0], len(corners))[..., None]
    places, (u, v) = (inner * corners).sum(axis=1), (inner * uv).sum(axis=1).T
    row, column = ((1 - v) * height).astype(int), (u * width).astype(int)
    error = np.abs(image[row, column, :3] / 255.0 - places)
    assert len(corners) == 192
    assert np.median(error) < 0.015
    assert np.percentile(error, 98) < 0.05
    a, b, c = corners.transpose(1, 0, 2)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(6.0, rel=1e-5)


def test_what_lies_behind_something_is_not_painted_on_it() -> None:
    """A wall behind a nearer one gets the colour of its own pictures only."""
    make = open3d().geometry.TriangleMesh.create_box
    wall, before = make(2.0, 2.0, 0.01), make(0.6, 0.6, 0.01).translate((0.7, 0.7, -0.5))
    mesh = wall + before
    shots = []
    for x in (0.3, 1.0, 1.7):
        T = np.eye(4)
        T[:3, 3] = [-x, -1.0, 2.0]
        scene = open3d().t.geometry.RaycastingScene()
        scene.add_triangles(open3d().t.geometry.TriangleMesh.from_legacy(mesh))
        rays = scene.create_rays_pinhole(CAMERA.matrix(), T, 160, 120)
        near = scene.cast_rays(rays)["t_hit"].numpy() < 1.7
        shots.append((CAMERA, T, np.where(near[..., None], [1.0, 0, 0], [0, 0, 1.0])))
    done = painted(unwrapped(mesh, texture=256), shots)
    height, width = done.image.shape[:2]
    centre = done.vertices[done.triangles].mean(axis=1)
    column, row = (done.uv[done.triangles].mean(axis=1) * [width, height]).astype(int).T
    red = done.image[row, column, 0] > 128
    front = np.abs(np.cross(*np.diff(done.vertices[done.triangles], axis=1).transpose(1, 0, 2))[:, 2]) > 0.05
    faces = front & ((np.abs(centre[:, 2]) < 1e-4) | (np.abs(centre[:, 2] + 0.5) < 1e-4))
    assert faces.sum() == 4
    np.testing.assert_array_equal(red[faces], centre[faces, 2] < -0.4)


def test_many_triangles_are_simplified() -> None:
    sphere = open3d().geometry.TriangleMesh.create_sphere(1.0, 30)
    done = unwrapped(sphere, triangles=500, texture=128)
    assert 300 < len(done.triangles) <= 500
    assert np.linalg.norm(done.vertices, axis=1) == pytest.approx(1.0, abs=0.05)
    assert done.uv.min() >= 0 and done.uv.max() <= 1
