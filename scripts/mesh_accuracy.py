"""Measure the accuracy of an exported mesh of the demo room against the room's true surface.

    modp-ti run demo/scene.yaml
    modp-ti export out/demo --format mesh
    python scripts/mesh_accuracy.py out/demo

prints precision, the share of vertices close to the true surface, and recall, the share of the true surface seen by
mapped frames that has a vertex close to it. The distances are 0.5, 1 and 2 percent of the room's size. The picture
behind the window is no part of the true surface and is not counted.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from ending import documented_ending
from numpy.typing import NDArray

from fields.geometry.se3 import camera_centres
from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError
from modp_ti.inputs.ground_truth import open_ground_truth, true_poses
from modp_ti.outputs.formats.mesh import read_mesh
from modp_ti.outputs.formats.open3d_io import open3d
from modp_ti.outputs.playback.finished_run import FinishedRun, open_run

DEMO = Path(__file__).resolve().parent.parent / "demo"
# Focal length of the demo's camera, relative to the image width.
FOCAL = 0.8
# Longest inner side of the room [m], and the tolerance as a fraction of it.
ROOM = 4.8
TOLERANCE = 0.01
# The outer side of the wall with the window [m]; the picture lies at smaller x.
WINDOW_WALL = -2.6
# Voxel size for thinning the points of the true surface [m].
SPACING = 0.01


def true_surface(file: Path, width: int, height: int, poses: Iterable[NDArray]) -> NDArray[np.float64]:
    """Return the points (N, 3) [m] of a triangle mesh that images see from T_camera_world (4, 4)."""
    o3d = open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.io.read_triangle_mesh(str(file)))
    focal = FOCAL * width
    K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    seen = o3d.geometry.PointCloud()
    for T in poses:
        rays = scene.create_rays_pinhole(K, T, width, height)
        t = scene.cast_rays(rays)["t_hit"].numpy()[..., None]
        points = rays.numpy()[..., :3] + t * rays.numpy()[..., 3:]
        seen.points.extend(points[np.isfinite(t[..., 0])].astype(np.float64))
        seen = seen.voxel_down_sample(SPACING)
    return np.asarray(seen.points)


def precision_recall(vertices: NDArray, surface: NDArray, tolerance: float) -> tuple[float, float]:
    """Return precision and recall of vertices (V, 3) against surface points (N, 3) for a distance tolerance."""
    o3d = open3d()
    mesh, true = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (vertices, surface))
    to_surface, to_mesh = mesh.compute_point_cloud_distance(true), true.compute_point_cloud_distance(mesh)
    return float(np.mean(np.asarray(to_surface) <= tolerance)), float(np.mean(np.asarray(to_mesh) <= tolerance))


def in_the_room(run: FinishedRun, truth: list[NDArray], points: NDArray) -> NDArray[np.float64]:
    """Align map points (N, 3) to the room by the similarity that fits the cameras.

    The rotation is estimated from the camera rotations, because the camera centres are nearly collinear and leave the
    rotation around that line undetermined.
    """
    turns = sum(there[:3, :3].T @ here[:3, :3] for here, there in zip(run.poses, truth, strict=True))
    U, _, Vt = np.linalg.svd(turns)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    estimate, target = camera_centres(run.poses), camera_centres(truth)
    a, b = (estimate - estimate.mean(axis=0)) @ R.T, target - target.mean(axis=0)
    s = (a * b).sum() / (a * a).sum()
    return s * (points - estimate.mean(axis=0)) @ R.T + target.mean(axis=0)


@documented_ending()
def main() -> None:
    """Print precision and recall."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("out", type=Path, help="output folder of a run of the demo")
    parser.add_argument("--mesh", type=Path, help="empty: OUT/mesh.ply")
    arguments = parser.parse_args()
    run = open_run(arguments.out)
    source = load_scene(run.folder / "config.yaml").source
    truth = open_ground_truth(source.ground_truth)
    if source.path != DEMO / "room.mp4" or truth is None:
        raise InputError(f"{run.folder}: not a run of demo/scene.yaml with its ground truth: its surface is not known")
    mesh = read_mesh(arguments.mesh or run.folder / "mesh.ply")
    poses, _ = true_poses(truth, run.timestamps.tolist())
    vertices = in_the_room(run, poses, np.asarray(mesh.vertices))
    camera = run.cameras[0]
    surface = true_surface(DEMO / "surface.ply", camera.width, camera.height, [poses[i] for i in run.mapped])
    vertices, surface = (points[points[:, 0] >= WINDOW_WALL] for points in (vertices, surface))
    for share in (TOLERANCE / 2, TOLERANCE, 2 * TOLERANCE):
        precision, recall = precision_recall(vertices, surface, share * ROOM)
        print(
            f"within {100 * share:.1f} % of the room's size ({1000 * share * ROOM:.0f} mm): "
            f"{100 * precision:.1f} % of {len(vertices):,} vertices, {100 * recall:.1f} % of the surface"
        )


if __name__ == "__main__":
    main()
