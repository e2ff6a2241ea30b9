"""A mesh with a texture: the surface is simplified and unwrapped, and painted from pictures of the map."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.compressed_splats import HALF_TURN
from modp_ti.outputs.formats.gltf import write_mesh_glb
from modp_ti.outputs.formats.mesh import open3d
from pipelines.surface.fusion import Paint

if TYPE_CHECKING:
    from open3d.pybind.geometry import TriangleMesh

# Most triangles of a textured mesh. The texture shows the detail, and the atlas of more takes minutes.
TRIANGLES = 60_000
# Approximate side of the texture, and distance between its charts [px].
TEXTURE, PADDING = 2048, 4


@dataclass(frozen=True)
class TexturedMesh:
    """A mesh with a texture.

    Attributes:
        vertices: (V, 3) positions.
        uv: (V, 2) places in the image in [0, 1], from its upper left corner.
        triangles: (T, 3) vertex indices.
        image: (H, W, 3) RGB.
    """

    vertices: NDArray[np.float32]
    uv: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    image: NDArray[np.uint8]


def require_atlas() -> Any:
    """Import and return xatlas.

    Raises:
        InputError: If it is not installed.
    """
    try:
        import xatlas  # pyright: ignore[reportMissingImports]  # an extra
    except ImportError:
        raise InputError("a texture needs xatlas: pip install 'modp-ti[texture]'") from None
    return xatlas


def unwrapped(mesh: TriangleMesh, triangles: int = TRIANGLES, texture: int = TEXTURE) -> TexturedMesh:
    """Simplify a mesh and lay its surface out in a texture, which is still black.

    Args:
        mesh: An Open3D TriangleMesh.
        triangles: Most triangles.
        texture: Approximate side of the texture [px].
    """
    xatlas = require_atlas()
    if len(mesh.triangles) > triangles:
        mesh = mesh.simplify_quadric_decimation(triangles)
        mesh.remove_degenerate_triangles()
        mesh.remove_unreferenced_vertices()
    vertices = np.asarray(mesh.vertices, dtype=np.float32)
    atlas, pack = xatlas.Atlas(), xatlas.PackOptions()
    pack.resolution, pack.padding, pack.bilinear = texture, PADDING, True
    atlas.add_mesh(vertices, np.asarray(mesh.triangles, dtype=np.uint32))
    atlas.generate(xatlas.ChartOptions(), pack)
    of_vertex, corners, uv = atlas[0]
    image = np.zeros((atlas.height, atlas.width, 3), np.uint8)
    return TexturedMesh(vertices[of_vertex], np.asarray(uv, np.float32), np.asarray(corners, np.uint32), image)


def painted(
    mesh: TexturedMesh,
    shots: Iterable[tuple[PinholeCamera, NDArray[np.float64], NDArray[np.floating]]],
) -> TexturedMesh:
    """Fill the texture of a mesh.

    Args:
        mesh: An unwrapped mesh.
        shots: Camera, T_camera_world (4, 4), and colours (H, W, 3) in [0, 1] of each picture.

    Returns:
        The mesh with its texture. What no picture saw has the colour of the nearest place in the texture.
    """
    core = open3d().core
    height, width = mesh.image.shape[:2]
    flat = np.column_stack([mesh.uv * [width, height], np.zeros(len(mesh.uv))])
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    down = np.stack([column, row, np.ones_like(row), 0 * row, 0 * row, -np.ones_like(row)], axis=2)
    hits = _scene(flat, mesh.triangles).cast_rays(core.Tensor(down.astype(np.float32)))
    inside = np.isfinite(hits["t_hit"].numpy())
    triangle = hits["primitive_ids"].numpy()[inside]
    u, v = np.moveaxis(hits["primitive_uvs"].numpy()[inside], -1, 0)[..., None]
    a, b, c = mesh.vertices[mesh.triangles[triangle]].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    paint = Paint((1 - u - v) * a + u * b + v * c, normals)
    surface = _scene(mesh.vertices, mesh.triangles)
    for camera, T, colour in shots:
        rays = surface.create_rays_pinhole(camera.matrix(), T, camera.width, camera.height)
        depth = surface.cast_rays(rays)["t_hit"].numpy()  # rays of unit depth
        paint.add(camera, T, np.where(np.isfinite(depth), depth, 0.0).astype(np.float32), colour.astype(np.float32))
    colours, seen = paint.colours()
    if not seen.any():
        raise InputError("no picture sees the surface")
    image, known = np.zeros((height, width, 3), np.float32), np.zeros((height, width), bool)
    image[inside], known[inside] = colours, seen
    # Labels of the nearest known texel for each texel.
    _, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.asarray(labels, dtype=np.int32)
    of_label = np.zeros((nearest.max() + 1, 3), np.float32)
    of_label[nearest[known]] = image[known]
    image = np.rint(255 * np.clip(of_label[nearest], 0, 1)).astype(np.uint8)
    return TexturedMesh(mesh.vertices, mesh.uv, mesh.triangles, image)


def write_textured_mesh(path: str | os.PathLike[str], mesh: TexturedMesh) -> None:
    """Write a textured mesh as GLB, rotated by 180 degrees around x, so that y points up."""
    write_mesh_glb(path, mesh.vertices * HALF_TURN, mesh.triangles, uv=mesh.uv, image=mesh.image)


def _scene(vertices: NDArray, triangles: NDArray) -> Any:
    """An Open3D RaycastingScene of a mesh."""
    o3d = open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(np.ascontiguousarray(vertices, np.float32)),
        o3d.core.Tensor(np.ascontiguousarray(triangles, np.uint32)),
    )
    return scene
