"""Camera pose from 2D-3D correspondences: P3P with RANSAC, refined by robust Gauss-Newton."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3, orthonormalised

__all__ = ["pose_from_points", "ray_errors", "refine_pose"]

STEPS = 10


def ray_errors(
    T_camera_world: NDArray[np.float64], xyz: NDArray[np.float64], rays: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Reprojection errors in normalised coordinates.

    Args:
        T_camera_world: (4, 4).
        xyz: (N, 3) world points.
        rays: (N, 2) observed normalised coordinates.

    Returns:
        Errors (N,), infinite for points behind the camera.
    """
    p = xyz @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    before = p[:, 2] > 1e-9
    z = np.where(before, p[:, 2], 1.0)
    return np.where(before, np.linalg.norm(p[:, :2] / z[:, None] - rays, axis=1), np.inf)


def refine_pose(
    T_camera_world: NDArray[np.float64],
    xyz: NDArray[np.float64],
    rays: NDArray[np.float64],
    sigma: float,
    steps: int = STEPS,
) -> NDArray[np.float64]:
    """Minimise the reprojection error under a Cauchy loss by Gauss-Newton.

    Args:
        T_camera_world: (4, 4) initial pose.
        xyz: (N, 3) world points.
        rays: (N, 2) observed normalised coordinates.
        sigma: Scale of the loss, in normalised coordinates.
        steps: Gauss-Newton steps at most.

    Returns:
        T_camera_world (4, 4).
    """
    T = np.array(T_camera_world, dtype=np.float64)
    scale = max(float(np.median(np.abs(xyz @ T[2, :3] + T[2, 3]))), 1e-9) if len(xyz) else 1.0
    for _ in range(steps):
        p = xyz @ T[:3, :3].T + T[:3, 3]
        before = p[:, 2] > 1e-3 * scale
        p, seen = p[before], rays[before]
        if len(p) < 3:
            break
        z = p[:, 2]
        u, v = p[:, 0] / z, p[:, 1] / z
        residual = np.stack([u - seen[:, 0], v - seen[:, 1]], axis=1) / sigma
        weight = 1.0 / (1.0 + (residual**2).sum(axis=1))
        jacobian = np.zeros((len(p), 2, 6))
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = scale / z  # translation in units of the scene's depth
        jacobian[:, 0, 2], jacobian[:, 1, 2] = -scale * u / z, -scale * v / z
        jacobian[:, 0, 3], jacobian[:, 0, 4], jacobian[:, 0, 5] = -u * v, 1 + u * u, -v
        jacobian[:, 1, 3], jacobian[:, 1, 4], jacobian[:, 1, 5] = -(1 + v * v), u * v, u
        flat = jacobian.reshape(-1, 6) / sigma
        weighted = flat * np.repeat(weight, 2)[:, None]
        normal = weighted.T @ flat
        normal[np.diag_indices(6)] *= 1.0 + 1e-6
        normal[np.diag_indices(6)] += 1e-12 * np.trace(normal) + 1e-300
        step = -np.linalg.solve(normal, weighted.T @ residual.reshape(-1))
        step[:3] *= scale
        T = exp_se3(step) @ T
        if np.abs(step[3:]).max() < 1e-5 and np.abs(step[:3]).max() < 1e-5 * scale:
            break
    return orthonormalised(T)


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
