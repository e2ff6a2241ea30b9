"""Camera refinement: keyframe poses follow the gradient of the rendering loss on SE(3) (Section 3.3.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.keyframes import Keyframe
from fields.se3 import exp_se3, log_se3, orthonormalised
from pipelines.losses import PhotometricLoss
from pipelines.rendering import Renderer
from pipelines.settings import PoseSettings

__all__ = ["PoseAlignment", "PoseRefinement", "pixel_metric"]


# Depths that the metric takes to be in a view [its median depth].
NEAR_AND_FAR = (0.6, 1.6)


def pixel_metric(view: Keyframe) -> NDArray[np.float64]:
    """W (6, 6) of coordinates u of a pose's tangent, xi = W u, in which a step of |u| moves the image by |u| pixels.

    The root mean square over a grid of pixels at two depths. In these coordinates a small turn and a small shift, which
    look alike, no longer stand in one another's way, and the scale of the scene cancels.
    """
    camera = view.camera
    across, down = (np.arange(0.1, 1.0, 0.2) * side for side in (camera.width, camera.height))
    grid = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    p = np.concatenate([camera.unproject(grid, np.full(len(grid), d * view.median_depth)) for d in NEAR_AND_FAR])
    x, y, z = p.T
    fx, fy, zero = view.camera.fx / z, view.camera.fy / z, np.zeros(len(p))
    # d pixel / d xi of exp(xi) p = p + rho + omega x p
    by_point = np.stack([fx, zero, -fx * x / z, zero, fy, -fy * y / z], axis=1).reshape(-1, 2, 3)
    turned = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    J = np.concatenate([by_point, by_point @ turned], axis=2).reshape(-1, 6)
    H = J.T @ J / len(p)
    return np.linalg.inv(np.linalg.cholesky(H)).T


class PoseRefinement:
    """Adam on the tangent xi of a keyframe's T_camera_world, T <- exp(xi) T, in the coordinates of `pixel_metric`.

    The moments live in the keyframe and are expressed in its own camera frame, which an increment hardly turns.
    """

    BETAS = (0.9, 0.999)

    def __init__(self, settings: PoseSettings) -> None:
        self.settings = settings

    def step(self, view: Keyframe, gradient: NDArray[np.float64], rate: float) -> None:
        """Move `view` by about `rate` px against d loss / d xi (6,); a gradient that is not finite moves nothing."""
        if not np.isfinite(gradient).all():
            return
        beta1, beta2 = self.BETAS
        W = pixel_metric(view)
        # The prior: half the squared movement [px^2] away from the tracked pose. Views that agree with one another
        # could otherwise all drift away together.
        moved = np.linalg.solve(W, log_se3(view.correction))
        g = W.T @ gradient + self.settings.prior * moved
        view.pose_steps += 1
        view.pose_m = beta1 * view.pose_m + (1 - beta1) * g
        view.pose_v = beta2 * view.pose_v + (1 - beta2) * g**2
        m = view.pose_m / (1 - beta1**view.pose_steps)
        v = view.pose_v / (1 - beta2**view.pose_steps)
        xi = W @ (-rate * m / (np.sqrt(v) + 1e-15))
        view.T_camera_world = orthonormalised(exp_se3(xi) @ view.T_camera_world)


class PoseAlignment:
    """Aligns a new keyframe with the map as it stands, from coarse to fine levels of its pyramid, before it adds to it.

    Steps on the pose alone, at a rate that falls from `align_rate` pixels to a twentieth. Only pixels where the map is
    opaque count, since a new view also sees what the map does not hold yet.
    """

    MIN_OPACITY = 0.95
    # Share of a level's pixels below which the map says too little of the view.
    MIN_SHARE = 0.2
    # Levels of the pyramid that are used.
    LEVELS = 3
    FINAL = 0.05

    def __init__(self, settings: PoseSettings, renderer: Renderer, loss: PhotometricLoss) -> None:
        self.settings = settings
        self.renderer = renderer
        self.loss = loss
        self._refinement = PoseRefinement(settings)

    def align(self, view: Keyframe, near: float) -> None:
        """Move `view`. near: depth [scene units] below which nothing is drawn."""
        total = self.settings.align_steps
        levels = view.pyramid[: self.LEVELS][::-1]
        for image, steps in zip(levels, np.array_split(np.arange(total), len(levels)), strict=True):
            self.renderer.forward(image.camera, view.T_camera_world, near)
            rgba = image.rgba.copy()
            rgba[self.renderer.images.opacity_to_numpy() < self.MIN_OPACITY] = 0
            if np.mean(rgba[..., 3] > 0) < self.MIN_SHARE:
                return
            for step in steps:
                self.renderer.forward(image.camera, view.T_camera_world, near)
                self.renderer.images.set_reference(rgba)
                self.loss.forward()
                self.loss.backward(0.2)
                self.renderer.backward()
                rate = self.settings.align_rate * self.FINAL ** (step / max(total - 1, 1))
                self._refinement.step(view, self.renderer.camera_gradient(), rate)
                self.renderer.gaussians.clear_gradients()
        view.pose_m[:], view.pose_v[:], view.pose_steps = 0.0, 0.0, 0
