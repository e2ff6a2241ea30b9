"""Exposure: an affine colour transform (A, b) of each keyframe, estimated with the map.

image = (A colour + b) * vignette. The first keyframe is the identity, which fixes what the transforms and the map's
colours could otherwise share; the others are drawn to it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.map.keyframes import Keyframe
from pipelines.optimise.safeguards import Safeguards
from pipelines.render.cpu.photometric_model import IDENTITY
from pipelines.render.renderer import Renderer
from pipelines.settings import ExposureSettings

__all__ = ["ExposureRefinement", "fitted_exposure", "scene_colours"]

# A pixel of the map that is thinner than this says nothing about exposure.
MIN_OPACITY = 0.9
MIN_PIXELS = 100
# Colours of the scene may be brighter than a photograph's white, but not by more than a short exposure explains.
BRIGHTEST = 2.0
FIT_ROUNDS = 5
LEAST_RESIDUAL = 0.01


def scene_colours(view: Keyframe, pixels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Colours (N, 3) of the scene at pixels (N, 2) as (column, row) of a view: its image, not yet developed."""
    column, row = pixels.T
    colours = view.rgba[row, column, :3] / 255.0
    if view.vignette is not None:
        colours = colours / _vignette_at(view)[row, column]
    if view.exposure is not None:
        colours = (colours - view.exposure[:, 3]) @ np.linalg.pinv(view.exposure[:, :3]).T
    if view.vignette is None and view.exposure is None:
        return colours
    return np.clip(colours, 0.0, BRIGHTEST)


def _vignette_at(view: Keyframe) -> NDArray[np.float32]:
    """The vignette (H, W, 3) at the size of the view's image, which may be a level of its pyramid."""
    height, width = view.rgba.shape[:2]
    if view.vignette.shape[:2] == (height, width):
        return view.vignette
    return cv2.resize(view.vignette, (width, height), interpolation=cv2.INTER_AREA)


def fitted_exposure(
    colours: NDArray[np.floating], image: NDArray[np.floating], prior: NDArray[np.float64], prior_weight: float
) -> NDArray[np.float64]:
    """(A, b) (3, 4) with image = A colours + b for colours and image (N, 3), drawn to `prior` (3, 4).

    The least sum of absolute residuals [per pixel], by reweighted least squares: what the map shows wrongly are
    outliers. prior_weight: of the squared distance to the prior.
    """
    homogeneous = np.concatenate([colours, np.ones((len(colours), 1))], axis=1).astype(np.float64)
    weights = np.ones(len(colours))
    exposure = prior
    for _ in range(FIT_ROUNDS):
        weighted = homogeneous * (weights / len(colours))[:, None]
        normal = weighted.T @ homogeneous + prior_weight * np.eye(4)
        exposure = np.linalg.solve(normal, weighted.T @ image + prior_weight * prior.T).T
        residual = np.linalg.norm(homogeneous @ exposure.T - image, axis=1)
        weights = 1.0 / np.maximum(residual, LEAST_RESIDUAL)
        weights /= weights.mean()
    return exposure


class ExposureRefinement:
    """Adam on a keyframe's (A, b); the moments live in the keyframe. New keyframes start from a fit to the map."""

    BETAS = (0.9, 0.999)

    def __init__(self, settings: ExposureSettings, safeguards: Safeguards | None = None) -> None:
        """safeguards: where steps that are left out are counted."""
        self.settings = settings
        self.safeguards = Safeguards() if safeguards is None else safeguards

    def begin(self, view: Keyframe, renderer: Renderer, near: float) -> None:
        """Give a new keyframe its exposure, before the map changes for it: fitted to what the map shows there.

        view.exposure is the last keyframe's, None for the first one.
        """
        if not self.settings.enabled:
            return
        if view.exposure is None:
            view.exposure = np.array(IDENTITY)
            return
        renderer.forward(view.camera, view.T_camera_world, near)
        known = (renderer.images.opacity_to_numpy() > MIN_OPACITY) & (view.rgba[..., 3] > 0)
        if known.sum() < MIN_PIXELS:
            return
        image = view.rgba[known][:, :3] / 255.0
        if view.vignette is not None:
            image = image / _vignette_at(view)[known]
        colours = renderer.images.colour_to_numpy()[known]
        view.exposure = fitted_exposure(colours, image, view.exposure, self.settings.prior)

    def step(self, view: Keyframe, gradient: NDArray[np.float64], weight: float = 1.0) -> None:
        """Move `view` against d loss / d (A, b) (3, 4), and towards the identity. weight: that of the view's loss.

        A gradient that is not finite moves nothing.
        """
        if not np.isfinite(gradient).all():
            self.safeguards.exposure_steps += 1
            return
        gradient = gradient + 2.0 * weight * self.settings.regularisation * (view.exposure - IDENTITY)
        beta1, beta2 = self.BETAS
        view.exposure_steps += 1
        view.exposure_m = beta1 * view.exposure_m + (1 - beta1) * gradient
        view.exposure_v = beta2 * view.exposure_v + (1 - beta2) * gradient**2
        m = view.exposure_m / (1 - beta1**view.exposure_steps)
        v = view.exposure_v / (1 - beta2**view.exposure_steps)
        view.exposure = view.exposure - self.settings.learning_rate * m / (np.sqrt(v) + 1e-15)
