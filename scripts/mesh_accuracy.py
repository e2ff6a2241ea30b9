"""Measure the accuracy of an exported mesh of the demo room against the room's true surface.

    modp-ti run demo/scene.yaml
    modp-ti export out/demo --format mesh
    python scripts/mesh_accuracy.py out/demo

prints precision, the share of vertices close to the true surface, and recall, the share of the true surface seen by
mapped frames that has a vertex close to it. The distances are 0.5, 1 and 2 percent of the room's size. Both are given
for the whole scene and for the room alone, because a tenth of what the frames see is a picture four metres behind the
window.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from ending import documented_ending
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.runtime.backend import initialise
from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError
from modp_ti.inputs.synthetic import open_synthetic
from modp_ti.inputs.synthetic.renderer import RoomRenderer
from modp_ti.inputs.synthetic.room import LIT_LOWER
from modp_ti.outputs.formats.mesh import read_mesh
from modp_ti.outputs.formats.open3d_io import open3d
from modp_ti.outputs.playback.finished_run import FinishedRun, open_run

# Longest inner side of the room [m], and the tolerance as a fraction of it.
ROOM = 4.8
TOLERANCE = 0.01
# Voxel size for thinning the points of the true surface [m].
SPACING = 0.01


def unprojected(camera: PinholeCamera, T_camera_world: NDArray, depth: NDArray) -> NDArray[np.float64]:
    """Return the world points (N, 3) of a depth image (H, W), without unknown pixels."""
    row, column = np.nonzero(depth > 0)
    p = camera.unproject(np.stack([column, row], axis=1) + 0.5, depth[row, column])
    return (p - T_camera_world[:3, 3]) @ T_camera_world[:3, :3]


def true_surface(camera: PinholeCamera, poses: Iterable[NDArray], depths: Iterable[NDArray]) -> NDArray[np.float64]:
    """Return the room's points (N, 3) [m] that are seen in depth images (H, W) from true T_camera_world (4, 4)."""
    o3d = open3d()
    seen = o3d.geometry.PointCloud()
    for T, depth in zip(poses, depths, strict=True):
        seen.points.extend(unprojected(camera, T, depth))
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
    estimate, target = (np.array([-T[:3, :3].T @ T[:3, 3] for T in poses]) for poses in (run.poses, truth))
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
    config = load_scene(run.folder / "config.yaml")
    if config.tracker.kind != "synthetic":
        raise InputError(f"{run.folder}: not a run of the demo room: its surface is not known")
    mesh = read_mesh(arguments.mesh or run.folder / "mesh.ply")
    initialise("cpu")
    tracker = open_synthetic(config.source, config.tracker, RoomRenderer(texel=1.0))  # its lighting is not used
    vertices = in_the_room(run, tracker.ground_truth(), np.asarray(mesh.vertices))
    poses = [tracker.ground_truth()[index] for index in run.mapped]
    depths = (tracker.depth(index) for index in run.mapped)  # ray-cast, independent of map and mesh
    surface = true_surface(tracker.camera, poses, depths)
    for name, least in (("all", -np.inf), ("the room", LIT_LOWER[0])):
        parts = vertices[vertices[:, 0] >= least], surface[surface[:, 0] >= least]
        for share in (TOLERANCE / 2, TOLERANCE, 2 * TOLERANCE):
            precision, recall = precision_recall(*parts, share * ROOM)
            print(
                f"{name}, within {100 * share:.1f} % of the room's size ({1000 * share * ROOM:.0f} mm): "
                f"{100 * precision:.1f} % of {len(parts[0]):,} vertices, {100 * recall:.1f} % of the surface"
            )


if __name__ == "__main__":
    main()
