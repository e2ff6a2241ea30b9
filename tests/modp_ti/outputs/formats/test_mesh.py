"""Fused depth is the surface that it shows, and mesh files hold it for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.mesh import (
    TRUNCATION,
    SurfaceView,
    extracted,
    fused,
    open3d,
    supported,
    without_edges,
    write_mesh,
)
from tests.room import Room, pinhole, walk

if TYPE_CHECKING:
    import open3d as o3d

CAMERA = PinholeCamera(100.0, 100.0, 80.0, 60.0, 160, 120)
COLOUR = np.float32([0.25, 0.5, 1.0])


def plane_views(normal: np.ndarray, offset: float, count: int = 6) -> list[SurfaceView]:
    """A plane normal . X = offset from cameras that look along z, with the exact depth of every pixel's centre."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:120, :160] + 0.5
    rays = np.stack([(u - 80.0) / 100.0, (v - 60.0) / 100.0, np.ones_like(u)], axis=2)
    views = []
    for _ in range(count):
        centre = rng.uniform(-0.1, 0.1, 3)
        T = np.eye(4)
        T[:3, 3] = -centre
        z = (offset - normal @ centre) / (rays @ normal)
        seen = np.where((z > 0.3) & (z < 4), z, 0).astype(np.float32)
        views.append(SurfaceView(CAMERA, T, seen, np.tile(COLOUR, (120, 160, 1))))
    return views


def test_a_slanted_plane_is_fused_where_it_is() -> None:
    """No half pixel is lost: seen aslant, it would shift the plane by 20 mm at its far end."""
    normal = np.array([0.8, 0.0, -0.6])
    mesh = extracted(fused(plane_views(normal, -1.2), voxel=0.02, farthest=4.0))
    vertices = np.asarray(mesh.vertices)
    assert len(vertices) > 10_000
    for near, far in ((1.2, 1.8), (1.8, 2.5), (2.5, 3.5)):
        error = vertices[(vertices[:, 2] > near) & (vertices[:, 2] < far)] @ normal + 1.2
        assert abs(error.mean()) < 0.002  # a tenth of a voxel
        assert np.abs(error).mean() < 0.004
    # But for the rim, where a vertex lies beside voxels that nobody saw.
    coloured = np.abs(np.asarray(mesh.vertex_colors) - COLOUR).max(axis=1) < 2e-3
    assert coloured.mean() > 0.97  # 0.9858 to 0.9957 over eight draws


@pytest.mark.slow
def test_the_room_is_fused_to_its_true_surface(room: Room) -> None:
    """From true depth at true poses, most of it lies within half a percent of the room's size, both ways."""
    camera, poses = pinhole(160, 120), walk(20, step=0.1)
    grey = np.full((120, 160, 3), 0.5, np.float32)
    pixels = np.stack(np.meshgrid(np.arange(160), np.arange(120)), axis=2).reshape(-1, 2) + 0.5
    views, surface = [], []
    for T in poses:
        z = room.depth(camera, T, pixels)
        surface.append((camera.unproject(pixels, z) - T[:3, 3]) @ T[:3, :3])
        depth = without_edges(z.reshape(120, 160).astype(np.float32))
        views.append(SurfaceView(camera, T, depth, grey))
    mesh = supported(extracted(fused(views, voxel=0.025, farthest=10.0)), views, TRUNCATION * 0.025)
    vertices, true = (
        open3d().geometry.PointCloud(open3d().utility.Vector3dVector(xyz))
        for xyz in (mesh.vertices, np.concatenate(surface))
    )
    for one, other in ((vertices, true), (true, vertices)):
        near = np.asarray(one.compute_point_cloud_distance(other)) < 0.025
        assert near.mean() > 0.95  # 0.990 of the vertices, 0.980 of the surface; nothing here is random


def test_depth_is_left_out_at_the_edges_of_things() -> None:
    z = np.full((20, 20), 2.0, np.float32)
    z[:, 10:] = 3.0
    z[:, 9] = 2.6  # what compositing makes of an edge
    z[15:] = 0
    depth = without_edges(z)
    assert (depth[:15, :9] == 2.0).all() and (depth[:15, 10:] == 3.0).all()
    assert (depth[:, 9] == 0).all()
    assert (depth[15:] == 0).all()


def test_small_parts_on_their_own_go_and_large_ones_stay() -> None:
    sphere = open3d().geometry.TriangleMesh.create_sphere(1.0)
    other = open3d().geometry.TriangleMesh.create_sphere(0.5).translate((3.0, 0, 0))
    crumb = open3d().geometry.TriangleMesh.create_sphere(0.03).translate((0, 3.0, 0))
    mesh = supported(sphere + other + crumb, [], 0.1)
    vertices = np.asarray(mesh.vertices)
    assert vertices[:, 0].max() == pytest.approx(3.5)
    assert vertices[:, 1].max() == pytest.approx(1.0, abs=0.02)
    assert len(vertices) == len(sphere.vertices) + len(other.vertices)


def views_around(mesh: o3d.geometry.TriangleMesh, count: int) -> list[SurfaceView]:
    """Depth of a mesh from cameras on a circle around the y axis, which look at it."""
    geometry, camera, views = open3d().t.geometry, pinhole(320, 240), []
    scene = geometry.RaycastingScene()
    scene.add_triangles(geometry.TriangleMesh.from_legacy(mesh))
    for angle in np.linspace(0.0, 2.0 * np.pi, count, endpoint=False):
        T = np.eye(4)
        T[:3, :3] = [[np.cos(angle), 0.0, -np.sin(angle)], [0.0, 1.0, 0.0], [np.sin(angle), 0.0, np.cos(angle)]]
        T[2, 3] = 12.0
        rays = scene.create_rays_pinhole(camera.matrix(), T, camera.width, camera.height)
        z = scene.cast_rays(rays)["t_hit"].numpy()  # of rays with z = 1
        views.append(SurfaceView(camera, T, np.where(np.isfinite(z), z, 0.0), np.zeros((240, 320, 3), np.float32)))
    return views


def test_what_views_see_through_goes_and_what_they_see_stays() -> None:
    create = open3d().geometry.TriangleMesh
    sphere, wall = create.create_sphere(1.0), create.create_sphere(20.0)
    true, ghost = (create.create_sphere(0.05).translate((0.0, y, 0.0)) for y in (2.0, -2.0))
    views = views_around(sphere + wall + true, 16)
    for others, highest in ((true, 2.05), (ghost, 1.0), (true + ghost, 2.05)):
        y = np.asarray(supported(sphere + others, views, 0.1).vertices)[:, 1]
        assert (y.min(), y.max()) == pytest.approx((-1.0, highest), abs=0.03)  # few views see the pole


def test_of_few_views_one_is_enough_for_a_large_part_and_not_for_a_small_one() -> None:
    create = open3d().geometry.TriangleMesh
    sphere, crumb = create.create_sphere(1.0), create.create_sphere(0.03).translate((0.0, 2.0, 0.0))
    mesh = supported(sphere + crumb, views_around(sphere + crumb, 3), 0.1)
    assert len(mesh.vertices) == len(sphere.vertices)


def test_views_of_nothing_are_refused() -> None:
    empty = np.zeros((120, 160), np.float32)
    nothing = SurfaceView(CAMERA, np.eye(4), empty, np.zeros((120, 160, 3), np.float32))
    with pytest.raises(InputError, match="surface"):
        fused([nothing], voxel=0.02, farthest=4.0)


@pytest.fixture(scope="module")
def tetrahedron() -> o3d.geometry.TriangleMesh:
    mesh = open3d().geometry.TriangleMesh.create_tetrahedron()
    mesh.vertex_colors = open3d().utility.Vector3dVector([[1, 0, 0], [0, 0.5, 0], [0, 0, 0.2], [0.8, 0.8, 0.8]])
    return mesh


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_another_program_reads_places_triangles_and_colours(
    tmp_path: Path, tetrahedron: o3d.geometry.TriangleMesh, capfd: pytest.CaptureFixture[str], suffix: str
) -> None:
    path = tmp_path / f"mesh{suffix}"
    write_mesh(path, open3d().geometry.TriangleMesh(tetrahedron))
    assert capfd.readouterr() == ("", "")
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert b"partial" not in path.read_bytes(), "a name that it had only while it was written"
    back = open3d().io.read_triangle_mesh(str(path))
    vertices, colours = np.asarray(back.vertices), np.asarray(back.vertex_colors)
    if suffix == ".glb":
        vertices = vertices * [1, -1, -1]  # y is up there
        colours = np.where(colours <= 0.0031308, 12.92 * colours, 1.055 * colours ** (1 / 2.4) - 0.055)  # linear there
    corners = {tuple(np.round(v, 5)): c for v, c in zip(vertices, colours, strict=True)}
    for vertex, colour in zip(np.asarray(tetrahedron.vertices), np.asarray(tetrahedron.vertex_colors), strict=True):
        np.testing.assert_allclose(corners[tuple(np.round(vertex, 5))], colour, atol=0.5 / 255 + 1e-6)
    area = back.get_surface_area()
    assert area == pytest.approx(tetrahedron.get_surface_area(), rel=1e-5)
    assert len(back.triangles) == 4
    # Seen from outside, triangles still turn the same way.
    centre = vertices.mean(axis=0)
    for triangle in np.asarray(back.triangles):
        a, b, c = vertices[triangle]
        assert np.dot(np.cross(b - a, c - a), a - centre) > 0
