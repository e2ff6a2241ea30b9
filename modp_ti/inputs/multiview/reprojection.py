"""Reprojection errors in normalised coordinates, and poses and points that minimise them robustly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3, orthonormalised

POSE_STEPS = 10
POINT_STEPS = 6


@dataclass(frozen=True)
class Observations:
    """Observations of points in frames.

    Attributes:
        frame: (M,) int64 frame of each observation.
        point: (M,) int64 point of each observation.
        rays: (M, 2) normalised coordinates.
        sigma: (M,) uncertainty in normalised coordinates: one pixel of the image used for detection.
    """

    frame: NDArray[np.int64]
    point: NDArray[np.int64]
    rays: NDArray[np.float64]
    sigma: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.frame)

    def where(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> Observations:
        """Select observations by a mask (M,) or indices (K,)."""
        return Observations(self.frame[kept], self.point[kept], self.rays[kept], self.sigma[kept])

    def beside(self, other: Observations) -> Observations:
        """Concatenate with observations of other points, which are renumbered to follow these."""
        first = int(self.point.max()) + 1 if len(self) else 0
        return Observations(
            np.concatenate([self.frame, other.frame]),
            np.concatenate([self.point, other.point + first]),
            np.concatenate([self.rays, other.rays]),
            np.concatenate([self.sigma, other.sigma]),
        )


def ray_errors(
    T_camera_world: NDArray[np.float64], xyz: NDArray[np.float64], rays: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Reprojection errors in one view, in normalised coordinates.

    Args:
        T_camera_world: (4, 4).
        xyz: (N, 3) world points.
        rays: (N, 2) observed normalised coordinates.

    Returns:
        Errors (N,), infinite for points behind the camera.
    """
    return _errors(xyz @ T_camera_world[:3, :3].T + T_camera_world[:3, 3], rays)


def pixel_errors(
    camera: PinholeCamera, T_camera_world: NDArray[np.float64], xyz: NDArray[np.floating], pixels: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Reprojection errors (N,) [px] of points (N, 3) seen at pixels (N, 2) by a pinhole camera at a pose (4, 4).

    They are infinite for points behind the camera.
    """
    p = xyz @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    before = p[:, 2] > 1e-9
    error = np.full(len(p), np.inf)
    error[before] = np.linalg.norm(camera.project(p[before]) - pixels[before], axis=1)
    return error


def point_errors(poses: NDArray[np.float64], seen: Observations, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Reprojection errors (M,) [px of the image used for detection]; infinite behind the camera.

    Args:
        poses: (F, 4, 4) T_camera_world.
        seen: M observations.
        xyz: (P, 3) positions.
    """
    p = np.einsum("mij,mj->mi", poses[seen.frame, :3, :3], xyz[seen.point]) + poses[seen.frame, :3, 3]
    error = _errors(p, seen.rays) / seen.sigma
    return np.where(np.isfinite(error), error, np.inf)


def _errors(p: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Errors (N,) of points (N, 3) in the camera frame, infinite behind the camera."""
    before = p[:, 2] > 1e-9
    z = np.where(before, p[:, 2], 1.0)
    return np.where(before, np.linalg.norm(p[:, :2] / z[:, None] - rays, axis=1), np.inf)


def refine_pose(
    T_camera_world: NDArray[np.float64],
    xyz: NDArray[np.float64],
    rays: NDArray[np.float64],
    sigma: float,
    steps: int = POSE_STEPS,
) -> NDArray[np.float64]:
    """Minimise the reprojection error of a view over its pose, under a Cauchy loss.

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
    # Components come first: NumPy is faster on long contiguous rows.
    xyz, rays = np.ascontiguousarray(xyz.T, dtype=np.float64), np.ascontiguousarray(rays.T, dtype=np.float64)
    for _ in range(steps):
        p, seen = T[:3, :3] @ xyz + T[:3, 3:], rays
        before = p[2] > 1e-3 * scale
        if not before.all():
            p, seen = p[:, before], rays[:, before]
        if p.shape[1] < 3:
            break
        uv = p[:2] / p[2]
        u, v = uv
        residual = (uv - seen) / sigma
        root = 1.0 / np.sqrt(1.0 + residual[0] ** 2 + residual[1] ** 2)  # of the weights under the loss
        w = root / sigma
        near = w * (scale / p[2])  # translation in units of the scene's depth
        jacobian = np.zeros((6, 2, len(u)))
        jacobian[0, 0] = jacobian[1, 1] = near
        jacobian[2] = -near * uv
        uw, vw = u * w, v * w
        jacobian[3, 0], jacobian[4, 0], jacobian[5, 0] = -u * vw, w + u * uw, -vw
        jacobian[3, 1], jacobian[4, 1], jacobian[5, 1] = -(w + v * vw), u * vw, uw
        jacobian = jacobian.reshape(6, -1)
        left, right = jacobian @ jacobian.T, jacobian @ (root * residual).reshape(-1)
        left[np.diag_indices(6)] *= 1.0 + 1e-6
        left[np.diag_indices(6)] += 1e-12 * np.trace(left) + 1e-300
        step = -np.linalg.solve(left, right)
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
    found = estimated(pycolmap.estimate_absolute_pose, 1000.0 * rays, xyz, camera, options)
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


def refine_points(poses: NDArray[np.float64], seen: Observations, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Minimise the reprojection errors of many points over their positions, under a Cauchy loss.

    Args:
        poses: (F, 4, 4) T_camera_world, which are fixed.
        seen: Observations; their sigma is the scale of the loss.
        xyz: (P, 3) initial positions.

    Returns:
        Positions (P, 3) after POINT_STEPS Gauss-Newton steps.
    """
    rotation, translation = poses[seen.frame, :3, :3], poses[seen.frame, :3, 3]
    sigma = seen.sigma[:, None]
    for _ in range(POINT_STEPS):
        p = np.einsum("mij,mj->mi", rotation, xyz[seen.point]) + translation
        z = np.where(np.abs(p[:, 2]) < 1e-9, 1e-9, p[:, 2])
        uv = p[:, :2] / z[:, None]
        residual = (uv - seen.rays) / sigma
        weight = 1.0 / (1.0 + (residual**2).sum(axis=1))  # under the loss
        jacobian = (rotation[:, :2] - uv[:, :, None] * rotation[:, 2:]) / (z * seen.sigma)[:, None, None]
        weighted = weight[:, None, None] * jacobian
        left = sum_by_point(seen.point, np.einsum("mki,mkj->mij", weighted, jacobian), len(xyz))
        right = sum_by_point(seen.point, np.einsum("mki,mk->mi", weighted, residual), len(xyz))
        xyz = xyz - solve_damped(left, right, 1e-6)
    return xyz


def sum_by_point(point: NDArray[np.int64], values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Sum the values (M, ...) of each point; returns (count, ...)."""
    columns = values.reshape(len(values), -1).T
    sums = [np.bincount(point, weights=column, minlength=count).astype(np.float64) for column in columns]
    return np.stack(sums, axis=1).reshape(count, *values.shape[1:])


def solve_damped(left: NDArray[np.float64], right: NDArray[np.float64], damping: float) -> NDArray[np.float64]:
    """Solve symmetric systems (P, 3, 3) with damping. Points without observations give zero."""
    trace = np.trace(left, axis1=1, axis2=2)
    left = left + np.eye(3) * (damping * trace + (trace == 0))[:, None, None]
    return np.linalg.solve(left, right[..., None])[..., 0].astype(np.float64, copy=False)


P = ParamSpec("P")
R = TypeVar("R")


def estimated(estimator: Callable[P, R], *args: P.args, **options: P.kwargs) -> R | None:
    """Return what an estimator finds, None where it fails on these correspondences."""
    import cv2

    try:
        return estimator(*args, **options)
    except (cv2.error, ValueError, RuntimeError, IndexError):  # the latter three from C++, through pycolmap
        return None
