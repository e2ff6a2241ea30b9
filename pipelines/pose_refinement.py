"""Camera refinement: keyframe poses follow the gradient of the rendering loss on SE(3) (Section 3.3.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.keyframes import Keyframe
from fields.se3 import exp_se3, orthonormalised
from pipelines.losses import PhotometricLoss
from pipelines.rendering import Renderer
from pipelines.settings import PoseSettings

__all__ = ["PoseAlignment", "PoseRefinement"]


class PoseRefinement:
    """Adam on the tangent xi = (rho, omega) of a keyframe's T_camera_world, T <- exp(xi) T.

    Translation is stepped in units of the scene's depth, so that the scale of a monocular map does not matter. The
    moments live in the keyframe and are expressed in its own camera frame, which an increment hardly turns.
    """

    BETAS = (0.9, 0.999)

    def __init__(self, settings: PoseSettings) -> None:
        self.settings = settings

    def step(self, view: Keyframe, gradient: NDArray[np.float64], scene_depth: float, factor: float = 1.0) -> None:
        """Move `view` against d loss / d xi (6,), by the learning rate times `factor`.

        A gradient that is not finite moves nothing.
        """
        if not np.isfinite(gradient).all():
            return
        beta1, beta2 = self.BETAS
        view.pose_steps += 1
        view.pose_m = beta1 * view.pose_m + (1 - beta1) * gradient
        view.pose_v = beta2 * view.pose_v + (1 - beta2) * gradient**2
        m = view.pose_m / (1 - beta1**view.pose_steps)
        v = view.pose_v / (1 - beta2**view.pose_steps)
        rate = factor * self.settings.learning_rate * np.repeat([scene_depth, 1.0], 3)
        xi = -rate * m / (np.sqrt(v) + 1e-15)
        view.T_camera_world = orthonormalised(exp_se3(xi) @ view.T_camera_world)


class PoseAlignment:
    """Aligns a new keyframe with the map as it stands, from coarse to fine levels of its pyramid, before it adds to it.

    Adam on the pose alone, at a rate that falls from `align_rate` to a twentieth. Only pixels where the map is opaque
    count, since a new view also sees what the map does not hold yet.
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

    def align(self, view: Keyframe, near: float, scene_depth: float) -> None:
        """Move `view`. near: depth [scene units] below which nothing is drawn."""
        levels = view.pyramid[: self.LEVELS][::-1]
        steps = [len(part) for part in np.array_split(np.arange(self.settings.align_steps), len(levels))]
        done = 0
        for image, count in zip(levels, steps, strict=True):
            self.renderer.forward(image.camera, view.T_camera_world, near)
            rgba = image.rgba.copy()
            rgba[self.renderer.images.opacity_to_numpy() < self.MIN_OPACITY] = 0
            if np.mean(rgba[..., 3] > 0) < self.MIN_SHARE:
                return
            for _ in range(count):
                self.renderer.forward(image.camera, view.T_camera_world, near)
                self.renderer.images.set_reference(rgba)
                self.loss.forward()
                self.loss.backward(0.2)
                self.renderer.backward()
                rate = self.settings.align_rate * self.FINAL ** (done / max(self.settings.align_steps - 1, 1))
                self._refinement.step(
                    view, self.renderer.camera_gradient(), scene_depth, rate / self.settings.learning_rate
                )
                self.renderer.gaussians.clear_gradients()
                done += 1
        view.pose_m[:], view.pose_v[:], view.pose_steps = 0.0, 0.0, 0
