"""Depth from a render of the map, and construction of the estimators from the settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.map.keyframe import Keyframe
from pipelines.densify.depth.depthcov import DepthCov, load_depthcov
from pipelines.densify.depth.epipolar import EpipolarDepth
from pipelines.densify.depth.estimate import DepthEstimate, DepthEstimator, FusedDepth, point_depths, unknown_depth
from pipelines.densify.depth.gaussian_process import GaussianProcessDepth, ImageGuidedDepth
from pipelines.render.renderer import Renderer
from pipelines.settings import DepthSettings


def build_depth(settings: DepthSettings, renderer: Renderer, near: float, rng: np.random.Generator) -> DepthEstimator:
    """Build the estimator of `settings.sources`, or the fusion of several.

    Args:
        settings: Settings of the depth estimation.
        renderer: Renderer of the map.
        near: Depth below which nothing is drawn [median depths of the view].
        rng: Random generator.

    Raises:
        ValueError: If DepthCov's checkpoint cannot be used.
    """

    def depthcov() -> DepthCov:
        if settings.checkpoint is None:
            raise ValueError("depthcov needs its weights: set checkpoint")
        return DepthCov(settings, load_depthcov(settings.checkpoint), rng)

    makers: dict[str, Callable[[], DepthEstimator]] = {
        "constant": lambda: GaussianProcessDepth(settings, rng),
        "image": lambda: ImageGuidedDepth(settings, rng),
        "depthcov": depthcov,
        "epipolar": lambda: EpipolarDepth(settings.epipolar),
        "map": lambda: MapDepth(renderer, near),
    }
    estimators = [makers[source]() for source in settings.sources]
    return estimators[0] if len(estimators) == 1 else FusedDepth(estimators)


class MapDepth:
    """Expected depth of the render, where the map is opaque.

    The deviation combines two parts: the median error of the render at the view's tracked points, and the variation of
    the rendered depth around the pixel, since a depth edge may be misplaced.
    """

    MIN_OPACITY = 0.9
    # Depth is requested where the map is worst, but the tracked points are where it is best. Against a depth sensor, 39
    # percent of the errors were within one deviation without this factor, and 68 percent of the fused errors with it.
    CAUTION = 2.0
    # Side of the window in which the variation of depth is measured [px].
    WINDOW = 5

    def __init__(self, renderer: Renderer, near: float) -> None:
        """Create the estimator. Nothing is drawn nearer than `near` [median depths of the view]."""
        self.renderer = renderer
        self.near = near

    def estimate(self, view: Keyframe, neighbours: Sequence[Keyframe], pixels: NDArray[np.float64]) -> DepthEstimate:
        """See `DepthEstimator`. Overwrites the renderer's images."""
        places, z = point_depths(view)
        if len(z) == 0 or len(pixels) == 0 or len(self.renderer.gaussians) == 0:
            return unknown_depth(len(pixels))
        picture = self.renderer.render(view.camera, view.T_camera_world, self.near * view.median_depth)
        log_depth = np.log(np.maximum(picture.expected_depth(self.MIN_OPACITY), 1e-12)).astype(np.float32)
        kernel = np.ones((self.WINDOW, self.WINDOW), dtype=np.uint8)
        # A hole nearby counts as a large variation, since log_depth is very low there.
        variation = cv2.dilate(log_depth, kernel) - cv2.erode(log_depth, kernel)
        at_points = _at(log_depth, places) - np.log(z)
        at_points = at_points[_at(picture.opacity, places) >= self.MIN_OPACITY]
        if len(at_points) == 0:
            return unknown_depth(len(pixels))
        # 1.48 is the ratio of standard deviation to median absolute deviation of a normal distribution.
        common = 1.48 * np.median(np.abs(at_points))
        deviation = self.CAUTION * np.hypot(common, 0.5 * _at(variation, pixels))
        solid = _at(picture.opacity, pixels) >= self.MIN_OPACITY
        return DepthEstimate(np.where(solid, np.exp(_at(log_depth, pixels)), 1.0), np.where(solid, deviation, np.inf))


def _at(image: NDArray, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values (N,) of an image (H, W) at pixels (N, 2)."""
    column, row = np.floor(pixels).astype(int).T
    return image[row, column].astype(np.float64)
