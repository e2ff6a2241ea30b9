"""The map as coloured points, and its surface as a mesh, fused from depth into a truncated signed distance field.

The method is that of [Curless and Levoy 1996], in Open3D's sparse voxel block grid.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import NO_ORIGIN
from fields.geometry.camera import PinholeCamera
from fields.map.blocks import Boxes, planes_of, seen
from fields.map.gaussians import SH_C0
from modp_ti.files.atomic import written_aside
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.compressed_splats import HALF_TURN, opacities
from modp_ti.outputs.formats.gltf import write_mesh_glb
from pipelines.surface.fusion import integrate, supporting_views

if TYPE_CHECKING:
    from open3d.pybind.geometry import TriangleMesh
    from open3d.pybind.t.geometry import VoxelBlockGrid

MESH_SUFFIXES = (".ply", ".glb", ".obj")
# Truncation distance in voxels before and behind the surface. Larger values round off corners and merge the two sides
# of thin objects: on the demo, 85.6 percent of the vertices were correct with 2.5, 84.2 with 3, and 81.3 with 4.
TRUNCATION = 2.0
# Minimum number of views that must have seen a voxel or seen through it. One is enough, because other views agree with
# its depth already: with two, the demo has 1.6 percent less of the surface.
LEAST_VIEWS = 1.0
# Weight of a view that sees that a voxel is free. Depth that spreads beyond an outline is wrong in few views, and the
# others see through it: on the demo, 87.9, 89.4, 90.2 and 90.6 percent of the vertices are correct with 1, 2, 4 and 8.
# The last step gains too little for what it carves away.
FREE_WEIGHT = 4.0
# A pixel's depth is used if its opacity reaches LEAST_OPACITY and if it differs by at most the fraction LARGEST_STEP
# from a horizontal and from a vertical neighbour. At silhouettes, compositing yields expected depths between the object
# and its background. Maps are optimised for colour; their depth at opacities above 0.5 was measured to be no worse than
# above 0.9.
LEAST_OPACITY = 0.5
LARGEST_STEP = 0.05
# Vertices need this number of views that see them, at most one for every SHORT views.
VIEWS_OF_VERTEX, SHORT = 3, 16
# Connected parts with a smaller share of the total surface area are small. Their vertices need so many views, and at
# most this number of views that see through them for every one that sees them.
LEAST_PART = 0.002
VIEWS_OF_SMALL, THROUGH_SMALL = 6, 0.5
BLOCK = 8


def open3d() -> ModuleType:
    """Import and return Open3D.

    Raises:
        InputError: If the import fails, most often because of a missing system library.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(
            f"Open3D does not start ({error}); on Debian or Ubuntu: apt-get install libusb-1.0-0 libgomp1 libgl1"
        ) from None
    return open3d


@dataclass(frozen=True)
class SurfaceView:
    """Depth and colour seen by a camera.

    Attributes:
        camera: The camera.
        T_camera_world: (4, 4) pose.
        depth: (H, W) z, 0 where unknown.
        colour: (H, W, 3) in [0, 1].
    """

    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]
    depth: NDArray[np.float32]
    colour: NDArray[np.float32]


def without_edges(z: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the depth (H, W) with pixels at depth edges set to 0, which means unknown."""
    padded = np.pad(z, 1, mode="edge")
    across = np.minimum(np.abs(z - padded[1:-1, :-2]), np.abs(z - padded[1:-1, 2:]))
    down = np.minimum(np.abs(z - padded[:-2, 1:-1]), np.abs(z - padded[2:, 1:-1]))
    return np.where(np.maximum(across, down) <= LARGEST_STEP * z, z, 0).astype(np.float32)


def fused(views: Sequence[SurfaceView], voxel: float, farthest: float) -> VoxelBlockGrid:
    """Fuse views into a signed distance field. The engine must have been started.

    Args:
        views: Depth and colour of each view.
        voxel: Edge of the voxels [scene units].
        farthest: Depth beyond which pixels are ignored [scene units].

    Returns:
        An Open3D VoxelBlockGrid.

    Raises:
        InputError: If the views show no surface.
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
        if not ((view.depth > 0) & (view.depth < farthest)).any():
            continue
        depth = o3d.t.geometry.Image(core.Tensor(np.ascontiguousarray(view.depth[..., None])))
        K, T = core.Tensor(view.camera.matrix()), core.Tensor(np.ascontiguousarray(view.T_camera_world))
        grid.hashmap().activate(grid.compute_unique_block_coordinates(depth, K, T, 1.0, farthest, TRUNCATION))
    if grid.hashmap().size() == 0:
        raise InputError("the map shows no surface: nowhere is it opaque")
    # The field's arrays share their memory with the grid.
    used = grid.hashmap().active_buf_indices()
    blocks = BLOCK * grid.hashmap().key_tensor()[used.to(core.int64)].numpy()
    first, _ = grid.voxel_coordinates_and_flattened_indices(used[:1])
    offsets = np.rint(first.numpy() / voxel).astype(np.int32) - blocks[0]
    tsdf, weight = (grid.attribute(name).numpy().reshape(-1) for name in ("tsdf", "weight"))
    colours = grid.attribute("color").numpy().reshape(-1, 3)
    rows = BLOCK**3 * used.numpy().astype(np.int32)
    boxes = Boxes(voxel * (blocks - 0.5), voxel * (blocks + BLOCK - 0.5))
    for view in views:
        in_view = seen(planes_of(view.camera, view.T_camera_world, np.inf)[None], boxes)[0]
        integrate(
            blocks[in_view],
            rows[in_view],
            offsets,
            voxel,
            view.camera.matrix().astype(np.float32),
            np.ascontiguousarray(view.T_camera_world, np.float32),
            view.depth,
            np.float32(255.0) * view.colour,  # as Open3D stores them
            TRUNCATION * voxel,
            farthest,
            FREE_WEIGHT,
            tsdf,
            weight,
            colours,
        )
    return grid


def extracted(grid: VoxelBlockGrid) -> TriangleMesh:
    """Extract the surface with colours from a VoxelBlockGrid.

    Returns:
        An Open3D TriangleMesh.

    Raises:
        InputError: If too few views agree on a surface.
    """
    o3d = open3d()
    mesh = grid.extract_triangle_mesh(LEAST_VIEWS).to_legacy()
    if len(mesh.triangles) == 0:
        raise InputError("no frames agree on a surface; try larger voxels (--voxel)")
    # Rounding can move averaged colours beyond 1, which writers reject.
    mesh.vertex_colors = o3d.utility.Vector3dVector(np.clip(np.asarray(mesh.vertex_colors), 0.0, 1.0))
    return mesh


def supported(mesh: TriangleMesh, views: Sequence[SurfaceView], tolerance: float) -> TriangleMesh:
    """Remove the vertices of an Open3D TriangleMesh that too few views see. The engine must have been started.

    Small parts, which hang in the air as a rule, need more views than large ones.

    Args:
        mesh: The mesh.
        views: The views that it was fused from.
        tolerance: Largest distance of a vertex from the depth of a view that sees it [scene units].
    """
    placed = ((view.camera, view.T_camera_world, view.depth) for view in views)
    seeing, through = supporting_views(np.asarray(mesh.vertices), placed, tolerance)
    sure = (seeing >= VIEWS_OF_SMALL) & (through <= THROUGH_SMALL * seeing)
    triangles = np.asarray(mesh.triangles)
    of_triangle, _, areas = map(np.asarray, mesh.cluster_connected_triangles())
    sure[triangles[(areas >= LEAST_PART * areas.sum())[of_triangle]]] = True
    # Of a short video, a surface that one frame saw is better than none.
    unsure = ~sure | (seeing < min(VIEWS_OF_VERTEX, len(views) // SHORT))
    mesh.remove_vertices_by_mask(unsure.tolist())
    return mesh.remove_unreferenced_vertices()


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write a mesh with vertex colours as PLY, GLB or OBJ, by the suffix. The file appears whole or not at all.

    The axes are those of the poses. Only GLB, where y points up, is rotated by 180 degrees around x.

    Args:
        path: The file.
        mesh: An Open3D TriangleMesh.
    """
    if path.suffix.lower() == ".glb":
        vertices, triangles = np.asarray(mesh.vertices) * HALF_TURN, np.asarray(mesh.triangles)
        write_mesh_glb(path, vertices, triangles, np.asarray(mesh.vertex_colors))
        return
    o3d = open3d()
    mesh.compute_vertex_normals()
    level = o3d.utility.VerbosityLevel.Error  # OBJ has no normals of triangles, which needs no word
    with written_aside(path) as partial, o3d.utility.VerbosityContextManager(level):
        if not o3d.io.write_triangle_mesh(str(partial), mesh):
            raise OSError(None, "Open3D could not write the mesh")


def write_points(
    path: str | os.PathLike[str], state: Mapping[str, NDArray], origin: NDArray[np.float64] = NO_ORIGIN
) -> None:
    """Write the centres of the opaque Gaussians with their constant colours as binary PLY.

    Args:
        path: The file.
        state: Gaussians by name, as from `GaussianField.to_numpy`.
        origin: Where their origin lies in the world (3,), which the points are written in.
    """
    o3d = open3d()
    solid = opacities(state) >= LEAST_OPACITY  # the others are haze rather than surface
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(state["position"][solid].astype(np.float64) + origin))
    colours = np.clip(0.5 + SH_C0 * state["sh"][solid, 0].astype(np.float64), 0.0, 1.0)
    cloud.colors = o3d.utility.Vector3dVector(colours)
    with written_aside(Path(path)) as partial:
        if not o3d.io.write_point_cloud(str(partial), cloud):
            raise OSError(None, "Open3D could not write the points")
