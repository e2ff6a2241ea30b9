"""`mesh.ply`: the map's surface, by fusing depth seen from many places into a truncated signed distance field.

[Curless and Levoy 1996], in Open3D's voxel block grid: only blocks of voxels near a surface exist.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.glb import write_glb
from modp_ti.outputs.formats.open3d_io import open3d, written_aside

__all__ = [
    "LEAST_OPACITY",
    "MESH_SUFFIXES",
    "SurfaceView",
    "extracted",
    "fused",
    "read_mesh",
    "without_edges",
    "without_floating_parts",
    "write_mesh",
]

MESH_SUFFIXES = (".ply", ".glb", ".obj")
# The distance is kept up to this many voxels before and behind the surface. (More makes corners round, and the two
# sides of thin things one: of the demo room's mesh, five instead of three took four percent of the true vertices.)
TRUNCATION = 3.0
# A voxel counts where as many views have seen it.
LEAST_VIEWS = 2.0
# Depth is taken where as much of the light is stopped, and where it varies by no more than this share to one of the
# neighbours across and one of those down: at the edge of a thing, compositing makes pixels whose expected depth lies
# between the thing and what is behind it. (Maps are optimised for colour; their depth where they are more opaque than
# 0.5 was measured to be no worse than where they are more opaque than 0.9.)
LEAST_OPACITY = 0.5
LARGEST_STEP = 0.05
# A part on its own is kept where it has this share of the whole surface.
LEAST_PART = 0.002
BLOCK = 8


@dataclass(frozen=True)
class SurfaceView:
    """What a camera at T_camera_world (4, 4) sees: z (H, W), 0 where unknown, and colours (H, W, 3) in [0, 1]."""

    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]
    depth: NDArray[np.float32]
    colour: NDArray[np.float32]


def without_edges(z: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth (H, W), 0 where unknown, without the pixels at the edges of things."""
    padded = np.pad(z, 1, mode="edge")
    across = np.minimum(np.abs(z - padded[1:-1, :-2]), np.abs(z - padded[1:-1, 2:]))
    down = np.minimum(np.abs(z - padded[:-2, 1:-1]), np.abs(z - padded[2:, 1:-1]))
    return np.where(np.maximum(across, down) <= LARGEST_STEP * z, z, 0).astype(np.float32)


def fused(views: Iterable[SurfaceView], voxel: float, farthest: float) -> object:
    """The signed distance (an Open3D VoxelBlockGrid) in voxels of edge `voxel` of what is nearer than `farthest`.

    Both in scene units. Raises InputError where the views show no surface.
    """
    o3d = open3d()
    core = o3d.core
    grid = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(core.float32, core.float32, core.float32),
        attr_channels=((1), (1), (3)),
        voxel_size=float(voxel),
        block_resolution=BLOCK,
        block_count=10_000,
    )
    for view in views:
        depth = o3d.t.geometry.Image(core.Tensor(np.ascontiguousarray(view.depth[..., None])))
        colour = o3d.t.geometry.Image(core.Tensor(np.ascontiguousarray(view.colour, dtype=np.float32)))
        K, T = core.Tensor(view.camera.matrix()), core.Tensor(np.ascontiguousarray(view.T_camera_world))
        if not ((view.depth > 0) & (view.depth < farthest)).any():
            continue
        blocks = grid.compute_unique_block_coordinates(depth, K, T, 1.0, farthest, TRUNCATION)
        grid.integrate(blocks, depth, colour, K, K, T, 1.0, farthest, TRUNCATION)
    if grid.hashmap().size() == 0:
        raise InputError("the map shows no surface: nowhere is it opaque")
    return grid


def extracted(grid: object) -> object:
    """The surface (an Open3D TriangleMesh) with colours. Raises InputError where nowhere enough views agree on one."""
    o3d = open3d()
    mesh = grid.extract_triangle_mesh(LEAST_VIEWS).to_legacy()
    if len(mesh.triangles) == 0:
        raise InputError(f"no {LEAST_VIEWS:.0f} frames agree on a surface; try larger voxels (--voxel)")
    # Means of colours, off by rounding: writers complain of those beyond 1.
    mesh.vertex_colors = o3d.utility.Vector3dVector(np.clip(np.asarray(mesh.vertex_colors), 0.0, 1.0))
    return mesh


def without_floating_parts(mesh: object) -> object:
    """The mesh (an Open3D TriangleMesh) without the parts on their own that are a small share of its area."""
    of_triangle, _, areas = mesh.cluster_connected_triangles()
    areas = np.asarray(areas)
    mesh.remove_triangles_by_mask((areas < LEAST_PART * areas.sum())[np.asarray(of_triangle)])
    return mesh.remove_unreferenced_vertices()


def write_mesh(path: Path, mesh: object) -> None:
    """Write a mesh with its vertex colours as PLY, GLB or OBJ, by the ending. The file appears whole or not at all.

    The axes are those of the poses, but in GLB, where y is up, they are turned by half a turn around x.
    """
    if path.suffix.lower() == ".glb":
        vertices = np.asarray(mesh.vertices) * [1.0, -1.0, -1.0]
        write_glb(path, vertices, np.asarray(mesh.triangles), np.asarray(mesh.vertex_colors))
        return
    o3d = open3d()
    mesh.compute_vertex_normals()
    with written_aside(path) as partial:
        if not o3d.io.write_triangle_mesh(str(partial), mesh):
            raise OSError(None, "Open3D could not write the mesh")


def read_mesh(path: Path) -> object:
    """An Open3D TriangleMesh from a file. Raises InputError where there is none."""
    o3d = open3d()
    if not path.is_file():
        raise InputError(f"{path}: no such file; modp-ti export OUT --format mesh makes a mesh")
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(str(path))
    if len(mesh.triangles) == 0:
        raise InputError(f"{path}: holds no triangle; modp-ti export OUT --format mesh makes a mesh")
    return mesh
