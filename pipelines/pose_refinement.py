"""Camera refinement: keyframe poses follow the gradient of the rendering loss on SE(3) (Section 3.3.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.keyframes import Keyframe
from fields.se3 import exp_se3, orthonormalised
from pipelines.settings import PoseSettings

__all__ = ["PoseRefinement"]


class PoseRefinement:
    """Adam on the tangent xi = (rho, omega) of a keyframe's T_camera_world, T <- exp(xi) T.

    Translation is stepped in units of the scene's depth, so that the scale of a monocular map does not matter. The
    moments live in the keyframe and are expressed in its own camera frame, which an increment hardly turns.
    """

    BETAS = (0.9, 0.999)

    def __init__(self, settings: PoseSettings) -> None:
        self.settings = settings

    def step(self, view: Keyframe, gradient: NDArray[np.float64], scene_depth: float) -> None:
        """Move `view` against d loss / d xi (6,). A gradient that is not finite moves nothing."""
        if not np.isfinite(gradient).all():
            return
        beta1, beta2 = self.BETAS
        view.pose_steps += 1
        view.pose_m = beta1 * view.pose_m + (1 - beta1) * gradient
        view.pose_v = beta2 * view.pose_v + (1 - beta2) * gradient**2
        m = view.pose_m / (1 - beta1**view.pose_steps)
        v = view.pose_v / (1 - beta2**view.pose_steps)
        rate = self.settings.learning_rate * np.repeat([scene_depth, 1.0], 3)
        xi = -rate * m / (np.sqrt(v) + 1e-15)
        view.T_camera_world = orthonormalised(exp_se3(xi) @ view.T_camera_world)
