"""Bundle adjustment of a few views beside fixed ones, in NumPy: several times faster than a call of Ceres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3, orthonormalised

__all__ = ["Window", "adjusted_window"]

TOLERANCE = 3e-5  # relative change of the cost below which the optimisation stops
# Damping, as a share of the diagonal of the normal equations: at first, and its factor after a good and a bad step.
DAMPING, EASED, STIFFENED = 1e-4, 0.1, 8.0
MOST_DAMPED = 1e4
# Cost of an observation behind its camera. It has no gradient.
BEHIND = 10.0


@dataclass(frozen=True)
class Window:
    """Views, points and observations of a bundle adjustment.

    Attributes:
        poses: (V, 4, 4) T_camera_world of all views.
        free: (F,) the views whose poses are optimised. The others are fixed.
        xyz: (P, 3) positions of the points.
        view: (M,) view of each observation, ascending.
        point: (M,) point of each observation. A view observes a point at most once.
        rays: (M, 2) normalised coordinates of each observation.
        sigma: Scale of the Cauchy loss, in normalised coordinates.
    """

    poses: NDArray[np.float64]
    free: NDArray[np.int64]
    xyz: NDArray[np.float64]
    view: NDArray[np.int64]
    point: NDArray[np.int64]
    rays: NDArray[np.float64]
    sigma: float


def adjusted_window(window: Window, steps: int) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Minimise the reprojection error under a Cauchy loss over the free poses and all points.

    Levenberg-Marquardt steps solve the normal equations for the poses, after the points are eliminated (Schur
    complement). Each point has a dense row of 3 x 6 F numbers, which is economical up to some thirty free views.

    Args:
        window: The problem, with its initial poses and points.
        steps: Steps at most.

    Returns:
        Poses (V, 4, 4), points (P, 3), and the mean cost per observation in units of sigma^2 / 2.
    """
    poses, xyz, damping = window.poses.copy(), window.xyz, DAMPING
    terms = _residuals(window, poses, xyz)
    equations = _normal_equations(window, terms)
    for _ in range(steps):
        motion, shift = _solution(equations, damping)
        moved = poses.copy()
        for k, step in zip(window.free, motion, strict=True):
            moved[k] = exp_se3(step) @ poses[k]
        trial = _residuals(window, moved, xyz + shift)
        gain = terms.cost - trial.cost
        if not gain > 0.0:  # also where the step is not finite
            damping *= STIFFENED
            if damping > MOST_DAMPED or abs(gain) < TOLERANCE * terms.cost:
                break
            continue
        poses, xyz, damping = moved, xyz + shift, max(damping * EASED, 1e-12)
        before, terms = terms.cost, trial
        if gain < TOLERANCE * before:
            break
        equations = _normal_equations(window, terms)
    for k in window.free:
        poses[k] = orthonormalised(poses[k])
    return poses, xyz, terms.cost / max(len(window.view), 1)


@dataclass(frozen=True)
class _Residuals:
    """The observations at given poses and points.

    Attributes:
        rotation: (3, 3, M) rotation of each observation's view.
        u, v: (M,) projections.
        inverse_depth: (M,).
        residual: (2, M) in units of sigma.
        weight: (M,) of the squared residuals.
        cost: Sum of the losses.
    """

    rotation: NDArray[np.float64]
    u: NDArray[np.float64]
    v: NDArray[np.float64]
    inverse_depth: NDArray[np.float64]
    residual: NDArray[np.float64]
    weight: NDArray[np.float64]
    cost: float


def _residuals(window: Window, poses: NDArray[np.float64], xyz: NDArray[np.float64]) -> _Residuals:
    # Components come first: NumPy is several times faster on long contiguous rows.
    motion = np.ascontiguousarray(poses[:, :3].transpose(1, 2, 0))[:, :, window.view]
    rotation, translation = motion[:, :3], motion[:, 3]
    place = np.ascontiguousarray(xyz.T)[:, window.point]
    x, y, z = (
        R[0] * place[0] + R[1] * place[1] + R[2] * place[2] + t for R, t in zip(rotation, translation, strict=True)
    )
    before = z > 1e-9
    inverse_depth = 1.0 / np.where(before, z, 1.0)
    u, v = x * inverse_depth, y * inverse_depth
    residual = (np.stack([u, v]) - window.rays.T) / window.sigma
    squared = residual[0] * residual[0] + residual[1] * residual[1]
    weight = np.where(before, 1.0 / (1.0 + squared), 0.0)
    cost = 0.5 * float(np.where(before, np.log1p(squared), BEHIND).sum())
    return _Residuals(rotation, u, v, inverse_depth, residual, weight, cost)


@dataclass(frozen=True)
class _Equations:
    """Normal equations: blocks of the poses and of the points, the blocks between them, and the gradients.

    Attributes:
        poses: (F, 6, 6).
        points: (P, 3, 3).
        between: (P, 3, 6 F).
        pose_gradient: (6 F,).
        point_gradient: (P, 3).
    """

    poses: NDArray[np.float64]
    points: NDArray[np.float64]
    between: NDArray[np.float64]
    pose_gradient: NDArray[np.float64]
    point_gradient: NDArray[np.float64]


def _normal_equations(window: Window, terms: _Residuals) -> _Equations:
    count, free = len(window.xyz), len(window.free)
    root = np.sqrt(terms.weight)
    residual = root * terms.residual
    root = root / window.sigma
    scale = root * terms.inverse_depth
    R = terms.rotation
    a, b = (R[0] - terms.u * R[2]) * scale, (R[1] - terms.v * R[2]) * scale  # (3, M) derivatives by the point
    points, point_gradient = np.empty((count, 3, 3)), np.empty((count, 3))
    for i in range(3):
        point_gradient[:, i] = np.bincount(window.point, a[i] * residual[0] + b[i] * residual[1], count)
        for j in range(i + 1):
            block = np.bincount(window.point, a[i] * a[j] + b[i] * b[j], count)
            points[:, i, j] = points[:, j, i] = block

    pose_blocks, pose_gradient = np.zeros((free, 6, 6)), np.zeros((free, 6))
    between = np.zeros((count, 3, free, 6))
    for k, view in enumerate(window.free):
        mine = slice(*np.searchsorted(window.view, (view, view + 1)))
        u, v, w, near = terms.u[mine], terms.v[mine], root[mine], scale[mine]
        none = np.zeros(len(u))
        by_pose = (
            np.stack([near, none, -u * near, -u * v * w, (1.0 + u * u) * w, -v * w]),
            np.stack([none, near, -v * near, -(1.0 + v * v) * w, u * v * w, u * w]),
        )  # (6, m) derivatives by the pose
        pose_blocks[k] = by_pose[0] @ by_pose[0].T + by_pose[1] @ by_pose[1].T
        pose_gradient[k] = by_pose[0] @ residual[0, mine] + by_pose[1] @ residual[1, mine]
        block = a[:, None, mine] * by_pose[0] + b[:, None, mine] * by_pose[1]
        between[window.point[mine], :, k] = block.transpose(2, 0, 1)
    return _Equations(pose_blocks, points, between.reshape(count, 3, -1), pose_gradient.reshape(-1), point_gradient)


def _solution(equations: _Equations, damping: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Steps (F, 6) of the poses and (P, 3) of the points."""
    inverse = np.linalg.inv(_damped(equations.points, damping))
    # With V^-1 = C C^T, the Schur complement U - W^T V^-1 W is symmetric to the last bit.
    factor = np.linalg.cholesky(inverse)
    halved = (factor.transpose(0, 2, 1) @ equations.between).reshape(-1, equations.between.shape[2])
    free = len(equations.poses)
    left = -(halved.T @ halved)
    blocks = left.reshape(free, 6, free, 6)
    blocks[np.arange(free), :, np.arange(free)] += _damped(equations.poses, damping)
    gradient = np.einsum("pji,pj->pi", factor, equations.point_gradient).reshape(-1)
    motion = np.linalg.solve(left, halved.T @ gradient - equations.pose_gradient)
    shift = -np.einsum("pij,pj->pi", inverse, equations.point_gradient + equations.between @ motion)
    return motion.reshape(free, 6), shift


def _damped(blocks: NDArray[np.float64], damping: float) -> NDArray[np.float64]:
    """Blocks (N, K, K) with their diagonals enlarged, and never zero."""
    diagonal = np.einsum("nii->ni", blocks)
    extra = damping * diagonal + 1e-9 * diagonal.mean(axis=1, keepdims=True) + 1e-9
    return blocks + extra[:, :, None] * np.eye(blocks.shape[1])
