"""Exposure: an affine colour transform (A, b) of each keyframe, estimated together with the map.

image = (A colour + b) * vignette. The transform of the first keyframe is fixed to the identity, which removes the
ambiguity between the transforms and the colours of the map. The others are regularised towards the identity.
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

# Pixels whose rendered opacity is at most this are not used to fit an exposure.
MIN_OPACITY = 0.9
MIN_PIXELS = 100
# Scene colours may exceed the white of a photograph (1), but not by more than a short exposure explains.
BRIGHTEST = 2.0
FIT_ROUNDS = 5
LEAST_RESIDUAL = 0.01


def scene_colours(view: Keyframe, pixels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Colours of the scene at pixels of a view: its image with vignette and exposure removed.

    Args:
        view: The view.
        pixels: Integer pixels (N, 2) as (column, row).

    Returns:
        Colours (N, 3), clipped to [0, 2] if the view has a vignette or an exposure.
    """
    column, row = pixels.T
    colours = view.rgba[row, column, :3] / 255.0
    if view.vignette is not None:
        colours = colours / _resized(view.vignette, view.rgba)[row, column]
    if view.exposure is not None:
        colours = (colours - view.exposure[:, 3]) @ np.linalg.pinv(view.exposure[:, :3]).T
    if view.vignette is None and view.exposure is None:
        return colours
    return np.clip(colours, 0.0, BRIGHTEST)


def _resized(vignette: NDArray[np.float32], rgba: NDArray[np.uint8]) -> NDArray[np.float32]:
    """The vignette (H, W, 3) at the size of an image, which may be a level of its pyramid."""
    height, width = rgba.shape[:2]
    if vignette.shape[:2] == (height, width):
        return vignette
    return np.asarray(cv2.resize(vignette, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32)


def fitted_exposure(
    colours: NDArray[np.floating], image: NDArray[np.floating], prior: NDArray[np.float64], prior_weight: float
) -> NDArray[np.float64]:
    """Fit an exposure (A, b) with image = A colours + b, regularised towards a prior.

    Minimises the absolute residuals by iteratively reweighted least squares, so that errors of the map act as outliers.

    Args:
        colours: Rendered colours (N, 3).
        image: Observed colours (N, 3).
        prior: Prior (A, b) (3, 4).
        prior_weight: Weight of the squared distance to the prior.

    Returns:
        Exposure (A, b) (3, 4).
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
    """Adam on the exposure (A, b) of keyframes, which store its moments. New keyframes start from a fit to the map."""

    BETAS = (0.9, 0.999)

    def __init__(self, settings: ExposureSettings, safeguards: Safeguards | None = None) -> None:
        """Create the optimiser of exposures.

        Args:
            settings: Settings of the exposure.
            safeguards: Counter of skipped steps; None for a new one.
        """
        self.settings = settings
        self.safeguards = Safeguards() if safeguards is None else safeguards

    def begin(self, view: Keyframe, renderer: Renderer, near: float) -> None:
        """Initialise the exposure of a new keyframe by a fit to the current render. Does nothing if disabled.

        `view.exposure` must hold the exposure of the last keyframe, which is the prior of the fit, or None for the
        first keyframe, whose exposure becomes the identity.

        Args:
            view: The new keyframe.
            renderer: Renderer of the map. Its images are overwritten.
            near: Depth below which nothing is drawn [scene units].
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
            image = image / _resized(view.vignette, view.rgba)[known]
        colours = renderer.images.colour_to_numpy()[known]
        view.exposure = fitted_exposure(colours, image, view.exposure, self.settings.prior)

    def step(self, view: Keyframe, gradient: NDArray[np.float64], weight: float = 1.0) -> None:
        """Make one Adam step on the exposure of a keyframe, with the regularisation towards the identity.

        A step with a gradient that is not finite is skipped.

        Args:
            view: The keyframe.
            gradient: d loss / d (A, b) (3, 4).
            weight: Weight of the view in the loss, which also scales the regularisation.
        """
        if not np.isfinite(gradient).all():
            self.safeguards.exposure_steps += 1
            return
        exposure = IDENTITY if view.exposure is None else view.exposure
        gradient = gradient + 2.0 * weight * self.settings.regularisation * (exposure - IDENTITY)
        beta1, beta2 = self.BETAS
        view.exposure_steps += 1
        view.exposure_m = beta1 * view.exposure_m + (1 - beta1) * gradient
        view.exposure_v = beta2 * view.exposure_v + (1 - beta2) * gradient**2
        m = view.exposure_m / (1 - beta1**view.exposure_steps)
        v = view.exposure_v / (1 - beta2**view.exposure_steps)
        view.exposure = exposure - self.settings.learning_rate * m / (np.sqrt(v) + 1e-15)
