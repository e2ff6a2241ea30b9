"""Poses of rigs of cameras, which minimise the reprojection errors of all their cameras together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3, orthonormalised
from modp_ti.inputs.multiview.reprojection import estimated

__all__ = ["refine_rig_pose", "relative_rig_pose", "rig_errors", "rig_pose_from_points"]

STEPS = 10
# The library has thresholds in pixels built in, so it is given a camera with this focal length [px].
FOCAL = 1000.0


def rig_errors(
    T_rig_world: NDArray[np.float64],
    mounts: NDArray[np.float64],
    camera: NDArray[np.int64],
    xyz: NDArray[np.float64],
    rays: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Reprojection errors (N,) in normalised coordinates; infinite for points behind their camera.

    Args:
        T_rig_world: (4, 4).
        mounts: (C, 4, 4) T_camera_rig.
        camera: (N,) the camera of each observation.
        xyz: (N, 3) world points.
        rays: (N, 2) observed normalised coordinates.
    """
    T = (mounts @ T_rig_world)[camera]
    p = np.einsum("nij,nj->ni", T[:, :3, :3], xyz) + T[:, :3, 3]
    before = p[:, 2] > 1e-9
    z = np.where(before, p[:, 2], 1.0)
    return np.where(before, np.linalg.norm(p[:, :2] / z[:, None] - rays, axis=1), np.inf)


def refine_rig_pose(
    T_rig_world: NDArray[np.float64],
    mounts: NDArray[np.float64],
    camera: NDArray[np.int64],
    xyz: NDArray[np.float64],
    rays: NDArray[np.float64],
    sigma: float,
) -> NDArray[np.float64]:
    """Minimise the reprojection error over the pose of a rig, under a Cauchy loss.

    With the point q in the axes of the rig, p = R q + t in those of its camera, and the pose moved by exp(xi) on the
    left, dp / dxi = R [I, -[q]_x].

    Args:
        T_rig_world: (4, 4) initial pose.
        mounts: (C, 4, 4) T_camera_rig.
        camera: (N,) the camera of each observation.
        xyz: (N, 3) world points.
        rays: (N, 2) observed normalised coordinates.
        sigma: Scale of the loss, in normalised coordinates.

    Returns:
        T_rig_world (4, 4).
    """
    T = np.array(T_rig_world, dtype=np.float64)
    R, t = mounts[camera, :3, :3], mounts[camera, :3, 3]
    for _ in range(STEPS):
        q = xyz @ T[:3, :3].T + T[:3, 3]
        p = np.einsum("nij,nj->ni", R, q) + t
        distance = np.linalg.norm(q, axis=1)
        scale = max(float(np.median(distance)), 1e-9) if len(q) else 1.0
        ahead = p[:, 2] > 1e-3 * scale
        if ahead.sum() < 3:
            break
        q, p, seen, turn = q[ahead], p[ahead], rays[ahead], R[ahead]
        uv = p[:, :2] / p[:, 2:]
        residual = (uv - seen) / sigma
        root = 1.0 / np.sqrt(1.0 + (residual**2).sum(axis=1))  # of the weights under the loss
        along = (turn[:, :2] - uv[:, :, None] * turn[:, 2:]) / (p[:, 2] * sigma)[:, None, None]  # d residual / dq
        jacobian = np.concatenate([along * scale, np.cross(q[:, None], along)], axis=2) * root[:, None, None]
        jacobian, weighted = jacobian.reshape(-1, 6), (root[:, None] * residual).reshape(-1)
        left, right = jacobian.T @ jacobian, jacobian.T @ weighted
        left[np.diag_indices(6)] *= 1.0 + 1e-6
        left[np.diag_indices(6)] += 1e-12 * np.trace(left) + 1e-300
        step = -np.linalg.solve(left, right)
        small = np.abs(step).max() < 1e-5
        step[:3] *= scale
        T = exp_se3(step) @ T
        if small:
            break
    return orthonormalised(T)


def rig_pose_from_points(
    mounts: NDArray[np.float64],
    camera: NDArray[np.int64],
    xyz: NDArray[np.float64],
    rays: NDArray[np.float64],
    max_error: float,
    seed: int,
) -> NDArray[np.float64] | None:
    """Estimate the pose (4, 4) of a rig with RANSAC, None if none is found. Arguments as for `refine_rig_pose`."""
    from modp_ti.files.quiet_pycolmap import pycolmap

    if len(xyz) < 6:
        return None
    found = estimated(
        pycolmap.estimate_generalized_absolute_pose,
        *(FOCAL * rays, xyz, camera.tolist(), _sensors(mounts), _cameras(mounts), _ransac(max_error, seed)),
    )
    return None if found is None else _finite(found["rig_from_world"])


def relative_rig_pose(
    mounts: NDArray[np.float64],
    camera_a: NDArray[np.int64],
    camera_b: NDArray[np.int64],
    rays_a: NDArray[np.float64],
    rays_b: NDArray[np.float64],
    max_error: float,
    seed: int,
) -> NDArray[np.float64] | None:
    """Estimate the motion T_b_a (4, 4) of a rig whose cameras share their centre, with a translation of length 1.

    Args:
        mounts: (C, 4, 4) T_camera_rig.
        camera_a: (N,) the camera of each feature at a.
        camera_b: (N,) the camera of the same feature at b.
        rays_a: (N, 2) normalised coordinates at a.
        rays_b: (N, 2) normalised coordinates at b.
        max_error: Inlier threshold, in normalised coordinates.
        seed: Seed of RANSAC.

    Returns:
        The motion; None if none is found.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    if len(rays_a) < 12:
        return None
    found = estimated(
        pycolmap.estimate_generalized_relative_pose,
        FOCAL * rays_a,
        FOCAL * rays_b,
        camera_a.tolist(),
        camera_b.tolist(),
        _sensors(mounts),
        _cameras(mounts),
        _ransac(max_error, seed),
    )
    if found is None:
        return None
    T = _finite(found.get("pano2_from_pano1") or found.get("rig2_from_rig1"))
    length = 0.0 if T is None else float(np.linalg.norm(T[:3, 3]))
    if T is None or length < 1e-9:
        return None
    T[:3, 3] /= length
    return T


def _ransac(max_error: float, seed: int):  # pycolmap is imported late
    from modp_ti.files.quiet_pycolmap import pycolmap

    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = FOCAL * max_error, seed
    options.confidence, options.max_num_trials, options.min_inlier_ratio = 0.9999, 2000, 0.05
    return options


def _sensors(mounts: NDArray[np.float64]) -> Sequence:
    from modp_ti.files.quiet_pycolmap import pycolmap

    return [pycolmap.Rigid3d(T[:3]) for T in mounts]


def _cameras(mounts: NDArray[np.float64]) -> Sequence:
    from modp_ti.files.quiet_pycolmap import pycolmap

    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=2000, height=2000, params=[FOCAL, 0.0, 0.0])
    return [camera] * len(mounts)


def _finite(pose) -> NDArray[np.float64] | None:  # a pycolmap.Rigid3d or None
    T = np.eye(4)
    if pose is None:
        return None
    T[:3] = pose.matrix()
    return T if np.isfinite(T).all() else None
