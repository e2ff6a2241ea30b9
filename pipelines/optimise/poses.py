"""Pose refinement on SE(3): by tracked points, by the rendering loss (Section 3.3.3), and of a view of a fixed map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera, pixel_jacobian, pixel_metric
from fields.geometry.se3 import exp_se3, log_se3, orthonormalised
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from fields.runtime.tenancy import in_engine
from pipelines.companions.exposure import MIN_OPACITY, MIN_PIXELS, fitted_gains
from pipelines.optimise.adam import Moments
from pipelines.render.renderer import Renderer
from pipelines.safeguards import Safeguards

# Threshold of the Huber loss on reprojection errors [px].
OUTLIER = 2.0


def reprojection(view: Keyframe, W: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Derivatives of half the mean reprojection error [px^2] with respect to u, xi = W u, under a Huber loss.

    The mean is over the view's tracked points in front of its camera.

    Args:
        view: The keyframe.
        W: Metric (6, 6) from `pixel_metric`.

    Returns:
        Gradient (6,) and Gauss-Newton Hessian (6, 6); zeros if no point is in front of the camera.
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
    """Refines T_camera_world of keyframes, T <- exp(xi) T, in the coordinates of `pixel_metric`.

    Adam's moments are expressed in the camera frame of their keyframe, in pixels. They are not transformed after a
    step, which rotates that frame only slightly, nor when the tracker revises the pose.

    Attributes:
        moments: Adam's moments of each keyframe.
    """

    # Gauss-Newton steps of an alignment, and the weight of half the squared distance to the tracked pose [px^2].
    ITERATIONS = 5
    PRIOR = 0.01
    # Largest image motion by refinement, as a fraction of the image's diagonal. Beyond it, the pose is wrong.
    FARTHEST = 0.5

    def __init__(self, safeguards: Safeguards | None = None) -> None:
        """Create the refinement, with a counter of rejected steps."""
        self.safeguards = Safeguards() if safeguards is None else safeguards
        self.moments = Moments(6)

    def align(self, view: Keyframe) -> None:
        """Minimise the reprojection error of the view's tracked points by Gauss-Newton.

        If a tracker's poses and points disagree, the points are more reliable, since there are many of them. A prior on
        the tracked pose constrains the directions that the points leave undetermined. If the optimisation diverges, the
        view keeps its pose.
        """
        W, before = pixel_metric(view.camera, view.median_depth), view.T_camera_world
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
        """Whether the pose is not finite, or farther than `FARTHEST` from the tracked pose."""
        moved = np.linalg.norm(np.linalg.solve(W, log_se3(view.correction)))
        return not moved <= self.FARTHEST * np.hypot(view.camera.width, view.camera.height)

    def step(self, view: Keyframe, gradient: NDArray[np.float64], rate: float) -> None:
        """Make one Adam step on the pose of a keyframe.

        A step with a gradient that is not finite is skipped. A step that diverges from the tracked pose is undone, and
        Adam's moments are reset.

        Args:
            view: The keyframe.
            gradient: d loss / d xi (6,).
            rate: Step size [px].
        """
        if not np.isfinite(gradient).all():
            self.safeguards.camera_steps += 1
            return
        before = view.T_camera_world
        W = pixel_metric(view.camera, view.median_depth)
        xi = W @ -self.moments.step(view.index, W.T @ gradient, rate)
        view.T_camera_world = orthonormalised(exp_se3(xi) @ view.T_camera_world)
        if self._runs_away(view, W):
            self.safeguards.camera_steps += 1
            view.T_camera_world = before
            self.moments.forget(view.index)


STEPS = 40
# Step lengths of the first and the last step [px]; they decay geometrically.
FIRST, LAST = 0.3, 0.02
SSIM_WEIGHT = 0.2
# Steps after which the exposure is fitted again, since a better pose gives better gains.
REFIT = 10


@in_engine("refine")
class ViewAlignment:
    """Refines the pose of a view so that the render of a fixed map resembles its image.

    The pose moves in the tangent of SE(3), see `PoseRefinement`. The exposure of the image is fitted as a gain per
    channel. Pixels where the map is not opaque do not count.

    Args:
        renderer: Renderer of the map. The gradients of its Gaussians are overwritten.
        near: Depth below which nothing is drawn [scene units].
    """

    def __init__(self, renderer: Renderer, near: float) -> None:
        self.renderer = renderer
        self.tenancy = renderer.tenancy
        self.near = near
        self.loss = renderer.loss

    def refine(
        self,
        image: NDArray[np.float32],
        valid: NDArray[np.bool_] | None,
        camera: PinholeCamera,
        T_camera_world: NDArray[np.float64],
        points: SparsePoints,
    ) -> NDArray[np.float64]:
        """Refine a pose.

        Args:
            image: Undistorted image (H, W, 3) in [0, 1].
            valid: Valid pixels (H, W); None for all.
            camera: Camera of the image.
            T_camera_world: Initial pose (4, 4), at most a few pixels off.
            points: Points that the view sees, for their depth.

        Returns:
            T_camera_world (4, 4).
        """
        frame = TrackedFrame(0, 0.0, "view", image, camera, T_camera_world, points, mask=valid)
        view, poses = KeyframeStore().append(frame), PoseRefinement()
        rgba, gains = frame.rgba, np.ones(3)
        for step in range(STEPS):
            self.renderer.forward(camera, view.T_camera_world, self.near)
            if step % REFIT == 0:
                known = (self.renderer.images.opacity_to_numpy() > MIN_OPACITY) & (frame.rgba[..., 3] > 0)
                if known.sum() < MIN_PIXELS:
                    break
                gains = fitted_gains(self.renderer.images.colour_to_numpy()[known], image[known], gains)
                rgba = np.dstack([frame.rgba[..., :3], known.astype(np.uint8) * np.uint8(255)])
            self.renderer.develop(np.column_stack([np.diag(gains), np.zeros(3)]), None)
            self.loss.forward(rgba)
            self.loss.backward(SSIM_WEIGHT)
            self.renderer.backward()
            rate = FIRST * (LAST / FIRST) ** (step / (STEPS - 1))
            poses.step(view, self.renderer.camera_gradient(), rate)
        self.renderer.gaussians.clear_gradients()
        return view.T_camera_world
