"""Construction of the depth estimators from the settings."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipelines.densify.depth.depthcov import DepthCov, load_depthcov
from pipelines.densify.depth.epipolar import EpipolarDepth
from pipelines.densify.depth.estimate import DepthEstimator, FusedDepth
from pipelines.densify.depth.gaussian_process import GaussianProcessDepth, ImageGuidedDepth
from pipelines.densify.depth.map_depth import MapDepth
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
