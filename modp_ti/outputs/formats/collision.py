"""What a game or a robot needs to know of a map's space: voxels, a floor plan for ROS, an OctoMap, a light mesh.

    voxels.npz           state (X, Y, Z): 0 unknown, 1 free, 2 solid; voxel; origin (3,) of the first voxel's corner in
                         the grid's axes, of which z points up; T_grid_world (4, 4); floor, its height or NaN
    map.pgm, map.yaml    a slice of it for `nav2_map_server`: black is solid, white free, grey unknown
    voxels.bt            the same for OctoMap
    mesh.glb             what bounds the free space that the cameras were in, in the axes of the other GLB files

The mesh bounds unknown space as it does walls: it is closed, and nothing leaves it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from modp_ti.outputs.formats.mesh import BLOCK, open3d
from pipelines.surface.free_space import VoxelSpace

if TYPE_CHECKING:
    from open3d.pybind.geometry import TriangleMesh

# Most triangles of the mesh, and rounds of smoothing, which takes the steps of the voxels away.
TRIANGLES, ROUNDS = 20_000, 10
# Depth of an OctoMap. Its middle is the origin.
DEPTH = 16
GREY = np.array([205, 254, 0], np.uint8)  # of UNKNOWN, FREE, SOLID


def write_voxels(path: Path, space: VoxelSpace, origin: NDArray[np.float64], floor: float | None) -> None:
    """Write voxels as NumPy's archive; `origin` (3,) is where that of the map's coordinates lies in the world."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = space.R_grid_world, -space.R_grid_world @ origin
    low = space.voxel * space.first
    height = np.nan if floor is None else floor
    np.savez_compressed(path, state=space.state, voxel=space.voxel, origin=low, T_grid_world=T, floor=height)


def write_ros_map(folder: Path, space: VoxelSpace, height: float) -> None:
    """Write the voxels at a height, in the grid's coordinates, as `map.pgm` and `map.yaml` of ROS."""
    layer = int(np.floor(height / space.voxel)) - space.first[2]
    layer = min(max(layer, 0), space.state.shape[2] - 1)
    picture = GREY[space.state[:, ::-1, layer].T]  # the upper row has the largest y
    head = f"P5\n{picture.shape[1]} {picture.shape[0]}\n255\n".encode()
    (folder / "map.pgm").write_bytes(head + picture.tobytes())
    x, y = space.voxel * space.first[:2]
    (folder / "map.yaml").write_text(
        f"image: map.pgm\nmode: trinary\nresolution: {space.voxel:.9g}\norigin: [{x:.9g}, {y:.9g}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )


def write_octomap(path: Path, space: VoxelSpace) -> None:
    """Write voxels as an OctoMap's `.bt`.

    The file holds each inner node as 16 bits, two for each of its children: 0 unknown, 1 free, 2 solid, 3 an inner node
    that follows. Nodes come before their children, which are ordered by their bits of x, then y, then z.
    """
    known = np.argwhere(space.state > 0)
    keys = known + space.first + (1 << DEPTH - 1)
    code = np.zeros(len(keys), np.int64)
    for bit in range(DEPTH):
        for axis in range(3):
            code |= (keys[:, axis] >> bit & 1) << 3 * bit + axis
    order = np.argsort(code)
    code, kind = code[order], space.state[tuple(known[order].T)].astype(np.int64)
    nodes, inner = 0, []
    for level in range(DEPTH):
        nodes += len(code)
        parent, start = np.unique(code >> 3, return_index=True)
        bits = np.bitwise_or.reduceat(kind << 2 * (code & 7), start)
        alike = (bits == 0x5555) | (bits == 0xAAAA)  # eight leaves of one kind are one
        nodes -= 8 * int(alike.sum())
        # In the order of the file: by the first voxel below a node, and of one voxel the larger node first.
        inner.append(np.stack([parent << 3 * (level + 1), np.full(len(parent), -level), bits])[:, ~alike])
        code, kind = parent, np.where(alike, bits & 3, 3)
    rows = np.concatenate(inner, axis=1)
    body = rows[2, np.lexsort(rows[1::-1])].astype("<u2").tobytes()
    head = f"# Octomap OcTree binary file\nid OcTree\nsize {nodes + 1}\nres {space.voxel:.9g}\ndata\n"
    path.write_bytes(head.encode() + body)


def boundary(space: VoxelSpace, inside: NDArray[np.bool_], triangles: int = TRIANGLES) -> TriangleMesh:
    """Return the closed surface that bounds voxels, with its front towards them, as an Open3D TriangleMesh.

    Args:
        space: The voxels.
        inside: (X, Y, Z) the voxels.
        triangles: Most triangles.
    """
    o3d = open3d()
    core = o3d.core
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1), (1)), space.voxel, block_resolution=BLOCK
    )
    padded = np.pad(inside, [(1, BLOCK - (side + 1) % BLOCK) for side in inside.shape])
    blocks = np.argwhere(np.ones([side // BLOCK for side in padded.shape]))
    grid.hashmap().activate(core.Tensor(blocks.astype(np.int32)))
    used = grid.hashmap().active_buf_indices()
    places, rows = grid.voxel_coordinates_and_flattened_indices(used)
    index = np.rint(places.numpy() / space.voxel).astype(np.int64)
    # The arrays share their memory with the grid.
    grid.attribute("tsdf").numpy().reshape(-1)[rows.numpy()] = padded[tuple(index.T)] - np.float32(0.5)
    grid.attribute("weight").numpy()[:] = 1.0
    mesh = grid.extract_triangle_mesh(0.5).to_legacy().filter_smooth_taubin(ROUNDS)
    if len(mesh.triangles) > triangles:
        mesh = mesh.simplify_quadric_decimation(triangles)
    # A voxel's place in the grid is its middle, and `padded` begins one voxel before.
    places = np.asarray(mesh.vertices) + space.voxel * (space.first - 0.5)
    mesh.vertices = o3d.utility.Vector3dVector(places @ space.R_grid_world)
    return mesh.paint_uniform_color([0.7, 0.7, 0.7])
