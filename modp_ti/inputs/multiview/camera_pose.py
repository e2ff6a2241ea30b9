"""Camera pose from 2D-3D correspondences: P3P with RANSAC, then robust Gauss-Newton."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.multiview.reprojection import ray_errors, refine_pose

__all__ = ["pose_from_points"]


def pose_from_points(
    xyz: NDArray[np.float64], rays: NDArray[np.float64], max_error: float, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
    """Estimate a pose by P3P with RANSAC and refine it.

    Args:
        xyz: (N, 3) world points.
        rays: (N, 2) observed normalised coordinates.
        max_error: Inlier threshold, in normalised coordinates.
        seed: Seed of RANSAC.

    Returns:
        T_camera_world (4, 4) and the inlier mask (N,); None if no pose is found.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    if len(xyz) < 4:
        return None
    options = pycolmap.AbsolutePoseEstimationOptions()
    # In pixels of a camera with focal length 1000, because the library has built-in thresholds in pixels.
    options.ransac.max_error = 1000.0 * max_error
    options.ransac.random_seed = seed
    options.ransac.confidence = 0.9999
    options.ransac.max_num_trials = 2000
    options.ransac.min_inlier_ratio = 0.05
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=2000, height=2000, params=[1000.0, 0.0, 0.0])
    found = pycolmap.estimate_absolute_pose(1000.0 * rays, xyz, camera, options)
    if found is None:
        return None
    T = np.eye(4)
    T[:3] = found["cam_from_world"].matrix()
    if not np.isfinite(T).all():
        return None
    inlier = np.asarray(found["inlier_mask"], dtype=bool).reshape(-1)
    for _ in range(2):
        if inlier.sum() < 4:
            return None
        T = refine_pose(T, xyz[inlier], rays[inlier], 0.5 * max_error)
        inlier = ray_errors(T, xyz, rays) <= max_error
    return T, inlier
