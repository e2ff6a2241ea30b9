"""Render an exported mesh from a frame's camera, in its colours and in grey shaded by slope.

modp-ti export OUT --format mesh
python scripts/mesh_picture.py OUT picture.png --frame 100
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from ending import documented_ending
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.mesh import read_mesh
from modp_ti.outputs.formats.open3d_io import open3d
from modp_ti.outputs.playback.finished_run import open_run

# Value of pixels where no ray hits the mesh.
BACKGROUND = 1.0


def pictures(mesh, camera: PinholeCamera, T_camera_world: NDArray) -> tuple[NDArray, NDArray]:
    """Render a mesh from a camera: vertex colours, and grey lit from the camera. Both are (H, W, 3) in [0, 1]."""
    o3d = open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    rays = scene.create_rays_pinhole(camera.matrix(), T_camera_world, camera.width, camera.height)
    hits = scene.cast_rays(rays)
    triangle = hits["primitive_ids"].numpy()
    hit = triangle != scene.INVALID_ID
    # Barycentric coordinates of the second and third corner.
    u, v = np.moveaxis(hits["primitive_uvs"].numpy()[hit], -1, 0)[..., None]
    a, b, c = np.asarray(mesh.vertex_colors)[np.asarray(mesh.triangles)[triangle[hit]]].transpose(1, 0, 2)
    direction = rays.numpy()[hit][:, 3:]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    facing = np.abs((hits["primitive_normals"].numpy()[hit] * direction).sum(axis=1, keepdims=True))
    coloured, grey = (np.full((*hit.shape, 3), BACKGROUND) for _ in range(2))
    coloured[hit] = (1 - u - v) * a + u * b + v * c
    grey[hit] = 0.15 + 0.75 * facing
    return coloured, grey


@documented_ending()
def main() -> None:
    """Write both pictures side by side."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="output folder of a run")
    parser.add_argument("picture", type=Path, help="PNG or JPEG to write")
    parser.add_argument("--mesh", type=Path, help="empty: OUT/mesh.ply")
    parser.add_argument("--frame", type=int, default=0, help="whose camera looks, counted from 0")
    parser.add_argument("--back", type=float, default=0.0, help="how far behind that camera [scene depths]")
    parser.add_argument("--width", type=int, default=640, help="of each of the two [px]")
    arguments = parser.parse_args()
    run = open_run(arguments.out)
    if not 0 <= arguments.frame < len(run):
        raise InputError(f"--frame {arguments.frame}: the run has frames 0 to {len(run) - 1}")
    mesh = read_mesh(arguments.mesh or run.folder / "mesh.ply")
    camera = run.cameras[arguments.frame]
    camera = camera.resized(arguments.width, round(arguments.width * camera.height / camera.width))
    T = run.poses[arguments.frame].copy()
    T[2, 3] += arguments.back * run.record.scene_depth
    both = np.hstack(pictures(mesh, camera, T))
    if not cv2.imwrite(str(arguments.picture), np.rint(255 * both[..., ::-1]).astype(np.uint8)):
        raise InputError(f"{arguments.picture}: could not be written")


if __name__ == "__main__":
    main()
