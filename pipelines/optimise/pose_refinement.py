"""Camera refinement on SE(3): by the tracked points and by the gradient of the rendering loss (Section 3.3.3)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3, log_se3, orthonormalised
from fields.map.keyframes import Keyframe
from pipelines.optimise.safeguards import Safeguards

__all__ = ["PoseRefinement", "pixel_jacobian", "pixel_metric", "reprojection"]

# Depths that the metric takes to be in a view [its median depth].
NEAR_AND_FAR = (0.6, 1.6)
# Reprojection errors beyond this [px] count as outliers and pull no harder (Huber).
OUTLIER = 2.0


def pixel_jacobian(camera: PinholeCamera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """d pixel / d xi (N, 2, 6) of camera-frame points (N, 3), z > 0, under exp(xi) at xi = 0."""
    x, y, z = points.T
    fx, fy, zero = camera.fx / z, camera.fy / z, np.zeros(len(points))
    by_point = np.stack([fx, zero, -fx * x / z, zero, fy, -fy * y / z], axis=1).reshape(-1, 2, 3)
    # exp(xi) p = p + rho + omega x p
    turned = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    return np.concatenate([by_point, by_point @ turned], axis=2)


def pixel_metric(view: Keyframe) -> NDArray[np.float64]:
    """W (6, 6) of coordinates u of a pose's tangent, xi = W u, in which a step of |u| moves the image by |u| pixels.

    The root mean square over a grid of pixels at two depths. In these coordinates a small turn and a small shift, which
    look alike, no longer stand in one another's way, and the scale of the scene cancels.
    """
    return _pixel_metric(view.camera, view.median_depth)


@lru_cache(maxsize=64)
def _pixel_metric(camera: PinholeCamera, median_depth: float) -> NDArray[np.float64]:
    across, down = (np.arange(0.1, 1.0, 0.2) * side for side in (camera.width, camera.height))
    grid = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    p = np.concatenate([camera.unproject(grid, np.full(len(grid), d * median_depth)) for d in NEAR_AND_FAR])
    J = pixel_jacobian(camera, p).reshape(-1, 6)
    W = np.linalg.inv(np.linalg.cholesky(J.T @ J / len(p))).T
    W.flags.writeable = False
    return W


def reprojection(view: Keyframe, W: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gradient (6,) and Gauss-Newton Hessian (6, 6) by u of half the mean squared reprojection error [px^2], Huber's.

    Over the view's tracked points that lie before its camera; xi = W u.
    """
    p = view.points.xyz @ view.T_camera_world[:3, :3].T + view.T_camera_world[:3, 3]
    before = p[:, 2] > 0.05 * view.median_depth
    if not before.any():
        return np.zeros(6), np.zeros((6, 6))
    residual = view.camera.project(p[before]) - view.points.pixels[before]
    length = np.linalg.norm(residual, axis=1)
    weight = np.minimum(1.0, OUTLIER / np.maximum(length, 1e-12)) / len(residual)
    J = pixel_jacobian(view.camera, p[before]) @ W
    return np.einsum("nij,ni,n->j", J, residual, weight), np.einsum("nij,nik,n->jk", J, J, weight)


class PoseRefinement:
    """Moves a keyframe's T_camera_world, T <- exp(xi) T, in the coordinates of `pixel_metric`.

    Adam's moments live in the keyframe and are expressed in its own camera frame, which an increment hardly turns.
    """

    BETAS = (0.9, 0.999)
    # Gauss-Newton steps of an alignment, and its weight of half the squared movement from the tracked pose [px^2].
    ITERATIONS = 5
    PRIOR = 0.01
    # Share of the image's diagonal by which refinement may move it: beyond, the camera shows something else.
    FARTHEST = 0.5

    def __init__(self, safeguards: Safeguards | None = None) -> None:
        """safeguards: where steps that are undone are counted."""
        self.safeguards = Safeguards() if safeguards is None else safeguards

    def align(self, view: Keyframe) -> None:
        """Move `view` to where its tracked points project to where they were tracked, by Gauss-Newton.

        A tracker's poses and points agree; where they do not, the points, of which there are many, know better. The
        prior holds what they leave open. Where it runs away the view stays where it was.
        """
        W, before = pixel_metric(view), view.T_camera_world
        try:
            for _ in range(self.ITERATIONS):
                gradient, H = reprojection(view, W)
                moved = np.linalg.solve(W, log_se3(view.correction))
                u = np.linalg.solve(H + self.PRIOR * np.eye(6), -gradient - self.PRIOR * moved)
                view.T_camera_world = orthonormalised(exp_se3(W @ u) @ view.T_camera_world)
            runs_away = self._runs_away(view, W)
        except (np.linalg.LinAlgError, FloatingPointError):
            runs_away = True
        if runs_away:
            self.safeguards.camera_steps += 1
            view.T_camera_world = before

    def _runs_away(self, view: Keyframe, W: NDArray[np.float64]) -> bool:
        """Whether the view stands nowhere, or so far from its tracked pose that it must see something else."""
        moved = np.linalg.norm(np.linalg.solve(W, log_se3(view.correction)))
        return not moved <= self.FARTHEST * np.hypot(view.camera.width, view.camera.height)

    def step(self, view: Keyframe, gradient: NDArray[np.float64], rate: float) -> None:
        """Move `view` by about `rate` px against d loss / d xi (6,).

        A gradient that is not finite moves nothing. A step that carries the view away is undone, and what had gathered
        for it is forgotten.
        """
        if not np.isfinite(gradient).all():
            self.safeguards.camera_steps += 1
            return
        before = view.T_camera_world
        beta1, beta2 = self.BETAS
        W = pixel_metric(view)
        g = W.T @ gradient
        view.pose_steps += 1
        view.pose_m = beta1 * view.pose_m + (1 - beta1) * g
        view.pose_v = beta2 * view.pose_v + (1 - beta2) * g**2
        m = view.pose_m / (1 - beta1**view.pose_steps)
        v = view.pose_v / (1 - beta2**view.pose_steps)
        xi = W @ (-rate * m / (np.sqrt(v) + 1e-15))
        view.T_camera_world = orthonormalised(exp_se3(xi) @ view.T_camera_world)
        if self._runs_away(view, W):
            self.safeguards.camera_steps += 1
            view.T_camera_world = before
            view.pose_m, view.pose_v, view.pose_steps = np.zeros(6), np.zeros(6), 0
