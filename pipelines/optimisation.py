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
        self.poses = PoseRefinement(settings.poses)
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

    def compare(self, view: Keyframe, scene_depth: float) -> LossValues:
        """Render a keyframe, developed as its image is, into the renderer's images and evaluate the loss."""
        self.renderer.forward(view.camera, view.T_camera_world, self.settings.near * scene_depth)
        self.renderer.develop(view.exposure, view.vignette)
        self.renderer.images.set_reference(view.rgba)
        return self.loss.forward()

    def step(
        self,
        store: KeyframeStore,
        views: list[int],
        rates: LearningRates,
        refine_poses: bool,
    ) -> float:
        """One Adam step on the mean loss of the views (indices into `store`); return their mean PSNR.

        The keyframes' errors are brought up to date. Poses move only where `refine_poses`, exposures only where they
        are estimated; those of the first keyframe are held, to fix the gauge.
        """
        o = self.settings.optimise
        psnr = 0.0
        pose_gradients: dict[int, np.ndarray] = {}
        exposure_gradients: dict[int, np.ndarray] = {}
        for j in views:
            view = store[j]
            values = self.compare(view, store.scene_depth)
            self.loss.backward(o.ssim_weight, 1.0 / len(views))
            self.renderer.backward()
            view.error = values.l1
            psnr += values.psnr / len(views)
            if refine_poses and j > 0:
                pose_gradients[j] = pose_gradients.get(j, 0.0) + self.renderer.camera_gradient()
            if view.exposure is not None and j > 0:
                exposure_gradients[j] = exposure_gradients.get(j, 0.0) + self.renderer.exposure_gradient()
        self.aspect.backward(o.aspect_weight, store.scene_depth)
        self.adam.step(rates, len(views))
        for j, gradient in pose_gradients.items():
            self.poses.step(store[j], gradient, store.scene_depth)
        for j, gradient in exposure_gradients.items():
            self.exposure.step(store[j], gradient, views.count(j) / len(views))
        return psnr
