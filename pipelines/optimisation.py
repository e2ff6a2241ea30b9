"""One optimisation step: a batch of views rendered, compared, differentiated; Gaussians and poses updated."""

from __future__ import annotations

import numpy as np

from fields.gaussians import GaussianField
from fields.keyframes import Keyframe, KeyframeStore
from pipelines.adam import Adam, LearningRates
from pipelines.exposure import ExposureRefinement
from pipelines.losses import AspectPenalty, LossValues, PhotometricLoss
from pipelines.pose_refinement import PoseRefinement
from pipelines.rendering import Renderer
from pipelines.settings import MappingSettings

__all__ = ["MapOptimiser"]


class MapOptimiser:
    """Renders with `renderer`, and keeps Gaussians and keyframes in step with their images."""

    def __init__(self, gaussians: GaussianField, renderer: Renderer, settings: MappingSettings) -> None:
        self.gaussians = gaussians
        self.renderer = renderer
        self.settings = settings
        self.loss = PhotometricLoss(renderer.images)
        self.aspect = AspectPenalty(gaussians)
        self.adam = Adam(gaussians)
        self.poses = PoseRefinement()
        self.exposure = ExposureRefinement(settings.exposure)

    def rates(self, scene_depth: float, position_factor: float = 1.0, scale_factor: float = 1.0) -> LearningRates:
        """The settings' learning rates, positions in scene units."""
        o = self.settings.optimise
        return LearningRates(
            position=o.position_rate * scene_depth * position_factor,
            log_scale=o.scale_rate * scale_factor,
            quaternion=o.rotation_rate,
            opacity_logit=o.opacity_rate,
            colour=o.colour_rate,
        )

    def compare(self, view: Keyframe, scene_depth: float, level: int = 0) -> LossValues:
        """Render a keyframe, develop it, and evaluate the loss against its image of a pyramid level."""
        image = view.image(level)
        self.renderer.forward(image.camera, view.T_camera_world, self.settings.near * scene_depth)
        self.renderer.develop(view.exposure, view.vignette)
        self.renderer.images.set_reference(image.rgba)
        return self.loss.forward()

    def step(
        self, store: KeyframeStore, views: list[int], rates: LearningRates, pose_rate: float, level: int = 0
    ) -> float:
        """Adam steps on the mean loss of the views (indices into `store`), in batches; return their mean PSNR.

        The keyframes' errors are brought up to date, and their poses but the first are stepped at `pose_rate` [px];
        so are their exposures where they are estimated.
        """
        size = self.settings.optimise.batch
        total = 0.0
        for first in range(0, len(views), size):
            batch = views[first : first + size]
            total += len(batch) * self._step(store, batch, rates, pose_rate, level)
        return total / len(views)

    def _step(
        self, store: KeyframeStore, views: list[int], rates: LearningRates, pose_rate: float, level: int
    ) -> float:
        o = self.settings.optimise
        psnr = 0.0
        pose_gradients: dict[int, np.ndarray] = {}
        exposure_gradients: dict[int, np.ndarray] = {}
        for j in views:
            view = store[j]
            values = self.compare(view, store.scene_depth, level)
            self.loss.backward(o.ssim_weight, 1.0 / len(views))
            self.renderer.backward()
            view.error = values.l1
            psnr += values.psnr / len(views)
            if pose_rate > 0 and j > 0:
                pose_gradients[j] = pose_gradients.get(j, 0.0) + self.renderer.camera_gradient()
            if view.exposure is not None and j > 0:
                exposure_gradients[j] = exposure_gradients.get(j, 0.0) + self.renderer.exposure_gradient()
        self.aspect.backward(o.aspect_weight, store.scene_depth)
        self.adam.step(rates, len(views))
        for j, gradient in pose_gradients.items():
            self.poses.step(store[j], gradient, pose_rate)
        for j, gradient in exposure_gradients.items():
            self.exposure.step(store[j], gradient, views.count(j) / len(views))
        return psnr
