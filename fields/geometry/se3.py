"""SE(3): rigid motions and their tangents in NumPy, one of them also in PyTorch; similarities.

The tangent is xi = (rho, omega): translation first, then rotation. Increments act on the left, T <- exp(xi) T, so that
the tangent of a `T_camera_world` is expressed in the camera frame. A similarity is a matrix S_after_before (4, 4),
x -> s R x + t.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    import torch


# Below this angle [rad], the closed forms lose precision and their series are exact to rounding.
SMALL_ANGLE = 1e-4
IDENTITY = np.eye(3)


def hat(v: ArrayLike) -> NDArray[np.float64]:
    """Skew-symmetric matrix (3, 3) with hat(v) @ u = v x u."""
    x, y, z = np.asarray(v, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _coefficients(theta: float) -> tuple[float, float, float]:
    """sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3."""
    if theta < SMALL_ANGLE:
        t2 = theta * theta
        return 1.0 - t2 / 6.0, 0.5 - t2 / 24.0, 1.0 / 6.0 - t2 / 120.0
    return np.sin(theta) / theta, (1.0 - np.cos(theta)) / theta**2, (theta - np.sin(theta)) / theta**3


def exp_se3(xi: ArrayLike) -> NDArray[np.float64]:
    """Exponential map: rigid motion (4, 4) of a tangent xi = (rho, omega) (6,)."""
    xi = np.asarray(xi, dtype=np.float64)
    omega = hat(xi[3:])
    a, b, c = _coefficients(float(np.linalg.norm(xi[3:])))
    T = np.eye(4)
    T[:3, :3] += a * omega + b * omega @ omega
    T[:3, 3] = (IDENTITY + b * omega + c * omega @ omega) @ xi[:3]
    return T


def log_se3(T: ArrayLike) -> NDArray[np.float64]:
    """Logarithm: tangent (6,) of a rigid motion (4, 4), with a rotation angle in [0, pi]. Inverse of `exp_se3`."""
    T = np.asarray(T, dtype=np.float64)
    q = quaternion_from_matrix(T[:3, :3])
    if q[0] < 0:
        q = -q
    norm = float(np.linalg.norm(q[1:]))
    theta = 2.0 * np.arctan2(norm, q[0])
    omega = q[1:] * (theta / norm if norm > 1e-12 else 2.0)
    _, b, c = _coefficients(theta)
    w = hat(omega)
    V = IDENTITY + b * w + c * w @ w
    return np.concatenate([np.linalg.solve(V, T[:3, 3]), omega], dtype=np.float64)


def inverse_se3(T: ArrayLike) -> NDArray[np.float64]:
    """Inverse (4, 4) of a rigid motion (4, 4), from its transposed rotation."""
    T = np.asarray(T, dtype=np.float64)
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse


def camera_centres(poses: ArrayLike) -> NDArray[np.float64]:
    """World positions (N, 3) of cameras with T_camera_world (N, 4, 4)."""
    T_camera_world = np.asarray(poses)
    return -np.einsum("nji,nj->ni", T_camera_world[:, :3, :3], T_camera_world[:, :3, 3])


def inverse_poses(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Invert rigid motions (N, 4, 4)."""
    inverse = np.tile(np.eye(4), (len(poses), 1, 1))
    inverse[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    inverse[:, :3, 3] = camera_centres(poses)
    return inverse


def interpolate_se3(T_a: ArrayLike, T_b: ArrayLike, t: float) -> NDArray[np.float64]:
    """Interpolate between `T_a` (t = 0) and `T_b` (t = 1), both (4, 4), along a screw motion."""
    return exp_se3(t * log_se3(np.asarray(T_b) @ inverse_se3(T_a))) @ np.asarray(T_a, dtype=np.float64)


def orthonormalised(T: ArrayLike) -> NDArray[np.float64]:
    """Rigid motion nearest to T (4, 4). Removes the drift of long products of increments."""
    T = np.array(T, dtype=np.float64)
    u, _, vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return T


def matrix_from_quaternion(q: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) of a quaternion (w, x, y, z) of any length but zero."""
    q = np.asarray(q, dtype=np.float64)
    return matrices_from_unit_quaternions(q / np.linalg.norm(q))


def matrices_from_unit_quaternions(q: NDArray) -> NDArray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4) as (w, x, y, z), in the type of `q`."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_matrix(R: ArrayLike) -> NDArray[np.float64]:
    """Unit quaternion (w, x, y, z) of a rotation matrix (3, 3).

    The same numbers as `quaternions_from_matrices`. A pose refinement takes one at every step, and NumPy's calls on
    single numbers took a quarter of it.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(R, dtype=np.float64).tolist()
    x, y, z, xy, xz, yz = h - f, c - g, d - b, b + d, c + g, f + h
    squares = [1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i]
    k = squares.index(max(squares))
    q = [(squares[0], x, y, z), (x, squares[1], xy, xz), (y, xy, squares[2], yz), (z, xz, yz, squares[3])][k]
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return np.array([component / norm for component in q])


def quaternions_from_matrices(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions (N, 4) of rotation matrices (N, 3, 3), from their largest component for numerical stability."""
    R = np.moveaxis(R, 0, -1)
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    # Row k is 4 q_k q.
    rows = np.array(
        [
            [1 + R[0, 0] + R[1, 1] + R[2, 2], x, y, z],
            [x, 1 + R[0, 0] - R[1, 1] - R[2, 2], xy, xz],
            [y, xy, 1 - R[0, 0] + R[1, 1] - R[2, 2], yz],
            [z, xz, yz, 1 - R[0, 0] - R[1, 1] + R[2, 2]],
        ]
    )
    k = np.argmax(rows[range(4), range(4)], axis=0)
    q = rows[k, :, np.arange(len(k))]
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def torch_exp_se3(xi: torch.Tensor) -> torch.Tensor:
    """PyTorch version of `exp_se3`: differentiable, for tangents (..., 6).

    Example:
        T = modp_ti.torch_exp_se3(torch.zeros(6, requires_grad=True))  # the identity (4, 4)
    """
    import torch  # here, because the readers of poses need this module and start without PyTorch

    zero = torch.zeros_like(xi[..., 0])
    a, b, c, x, y, z = xi.unbind(-1)
    rows = [(zero, -z, y, a), (z, zero, -x, b), (-y, x, zero, c), (zero, zero, zero, zero)]
    return torch.linalg.matrix_exp(torch.stack([torch.stack(row, -1) for row in rows], -2))


def scale_of(S: ArrayLike) -> NDArray[np.float64]:
    """Scale s of a similarity (4, 4), or scales (N,) of N similarities (N, 4, 4)."""
    return np.cbrt(np.linalg.det(np.asarray(S, dtype=np.float64)[..., :3, :3]))


def motion_around(T_before: ArrayLike, T_after: ArrayLike, scale: float = 1.0) -> NDArray[np.float64]:
    """Similarity of the world around a camera whose pose is revised.

    In the camera frame, everything keeps its direction and moves to `scale` times its distance.

    Args:
        T_before: Former pose T_camera_world (4, 4).
        T_after: Revised pose T_camera_world (4, 4).
        scale: Change of scale.

    Returns:
        S_after_before (4, 4), exactly the identity if the poses are bit-identical and the scale is 1.
    """
    if scale == 1.0 and np.array_equal(T_before, T_after):
        return np.eye(4)
    return inverse_se3(T_after) @ np.diag([scale, scale, scale, 1.0]) @ np.asarray(T_before, dtype=np.float64)


def moved_pose(S: NDArray[np.float64], T_camera_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """T_camera_world (4, 4) of a camera that moves with the world by S (4, 4), so that its image stays the same."""
    if np.array_equal(S, np.eye(4)):
        return T_camera_world.copy()
    s = float(scale_of(S))
    return orthonormalised(np.diag([s, s, s, 1.0]) @ T_camera_world @ np.linalg.inv(S))


def moved_points(S: NDArray[np.float64], xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Apply a similarity S (4, 4) to points (N, 3)."""
    return xyz.copy() if np.array_equal(S, np.eye(4)) else xyz @ S[:3, :3].T + S[:3, 3]
