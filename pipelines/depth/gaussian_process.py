"""Gaussian process on the log depths of a view's tracked points, with a constant kernel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from fields.keyframes import Keyframe
from pipelines.depth.covariance import matern32
from pipelines.depth.estimate import DepthEstimate, unknown_depth
from pipelines.depth.regression import MIN_POINTS, conditioning_points, regress_log_depth
from pipelines.settings import DepthSettings

__all__ = ["GaussianProcessDepth"]


class GaussianProcessDepth:
    """Gaussian process on the log depths of a view's tracked points, with a constant (stationary) kernel.

    Matern 3/2 over the image plane in units of the larger image side. Length scale, signal and noise are those of
    greatest marginal likelihood on the view's own points, over a small grid, so that the deviations mean something
    in rooms and in landscapes alike.
    """

    LENGTHS = (0.05, 0.1, 0.2, 0.4, 0.8)
    # Three numbers need no more points than this.
    FIT_POINTS = 150
    NOISE_RATIOS = (1e-3, 1e-2, 1e-1)

    def __init__(self, settings: DepthSettings, rng: np.random.Generator) -> None:
        self.settings = settings
        self._rng = rng

    def estimate(self, view: Keyframe, neighbours: Sequence[Keyframe], pixels: NDArray[np.float64]) -> DepthEstimate:
        """See `DepthEstimator`. Fewer than MIN_POINTS tracked points leave every pixel unknown."""
        places, z = conditioning_points(view, self.settings.max_points, self._rng)
        if len(z) < MIN_POINTS or len(pixels) == 0:
            return unknown_depth(len(pixels))
        side = max(view.camera.width, view.camera.height)
        known = torch.from_numpy(places / side)
        asked = torch.from_numpy(np.asarray(pixels, dtype=np.float64) / side)
        y = torch.from_numpy(np.log(z))
        some = slice(None, None, max(len(y) // self.FIT_POINTS, 1))
        length, ratio, variance = self._fit(known[some], (y - y.mean())[some])
        K = variance * matern32(torch.cdist(known, known) / length)
        k = variance * matern32(torch.cdist(asked, known) / length)
        return regress_log_depth(z, K, ratio * variance, k, variance)

    def _fit(self, known: torch.Tensor, y: torch.Tensor) -> tuple[float, float, float]:
        """(length scale, noise / signal, signal variance) of greatest likelihood; the variance in closed form."""
        distance = torch.cdist(known, known)
        n = len(y)
        best = (-np.inf, self.LENGTHS[0], self.NOISE_RATIOS[0], 1.0)
        for length in self.LENGTHS:
            K = matern32(distance / length)
            for ratio in self.NOISE_RATIOS:
                L = torch.linalg.cholesky(K + ratio * torch.eye(n, dtype=torch.float64))
                half = torch.linalg.solve_triangular(L, y[:, None], upper=False)[:, 0]
                variance = float((half @ half) / n) + 1e-12
                likelihood = -0.5 * n * np.log(variance) - float(torch.log(torch.diagonal(L)).sum())
                if likelihood > best[0]:
                    best = (likelihood, length, ratio, variance)
        return best[1:]
