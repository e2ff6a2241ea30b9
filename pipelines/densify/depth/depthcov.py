"""DepthCov: a Gaussian process on log depth with a covariance predicted from the image [Dexheimer 2023]."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from fields.map.keyframe import Keyframe
from pipelines.densify.depth.covariance import nonstationary_matern32, nonstationary_variance
from pipelines.densify.depth.depthcov_checkpoint import DepthCovWeights
from pipelines.densify.depth.depthcov_network import STRIDE, pixel_covariances
from pipelines.densify.depth.estimate import DepthEstimate, unknown_depth
from pipelines.densify.depth.regression import MIN_POINTS, conditioning_points, regress_log_depth
from pipelines.settings import DepthSettings

__all__ = ["DepthCov"]

BASE_NOISE = 1e-2


class DepthCov:
    """The paper's depth estimator for high-error pixels (Section 3.2.2).

    The network runs once per call on the whole image, resized to the nearest multiples of 32. The process is defined in
    coordinates from -1 to 1 along each side, which resizing preserves and padding would not. Noise and scale are those
    of the published weights, so that deviations are comparable with the paper's.

    Args:
        settings: Settings of the depth estimation.
        weights: Result of `load_depthcov`.
        rng: Random generator that selects the conditioning points.
    """

    def __init__(self, settings: DepthSettings, weights: DepthCovWeights, rng: np.random.Generator) -> None:
        self.settings = settings
        self._network = weights.network
        self._scale = math.exp(weights.log_scale)
        self._noise = BASE_NOISE * math.exp(weights.log_noise)
        self._rng = rng

    def estimate(self, view: Keyframe, neighbours: Sequence[Keyframe], pixels: NDArray[np.float64]) -> DepthEstimate:
        """See `DepthEstimator`. With fewer than `MIN_POINTS` tracked points, all depths are unknown."""
        places, z = conditioning_points(view, self.settings.max_points, self._rng)
        if len(z) < MIN_POINTS or len(pixels) == 0:
            return unknown_depth(len(pixels))
        covariances = self.covariances(view.rgba)
        size = np.array([view.camera.width, view.camera.height])
        known, asked = (torch.from_numpy(2.0 * p / size - 1.0).flip(1) for p in (places, np.asarray(pixels)))
        E_known, E_asked = _sampled(covariances, known), _sampled(covariances, asked)
        K = self._scale * nonstationary_matern32(known, E_known, known, E_known)
        k = self._scale * nonstationary_matern32(asked, E_asked, known, E_known)
        return regress_log_depth(z, K, self._noise, k, self._scale * nonstationary_variance(E_asked))

    @torch.inference_mode()
    def covariances(self, rgba: NDArray[np.uint8]) -> torch.Tensor:
        """Run the network on an image.

        Args:
            rgba: Image (H, W, 4).

        Returns:
            Covariances (1, 3, h, w) over (row, column) in [-1, 1]^2, with h and w multiples of 32.
        """
        image = torch.from_numpy(rgba[..., :3] / np.float32(255.0)).permute(2, 0, 1)[None]
        size = [max(round(side / STRIDE), 1) * STRIDE for side in image.shape[2:]]
        image = functional.interpolate(image, size, mode="bilinear", align_corners=False)
        return pixel_covariances(self._network(image.contiguous(memory_format=torch.channels_last)))


def _sampled(covariances: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Covariances (N, 3) float64 at points (N, 2) as (row, column) in [-1, 1]: bilinear, reflected at the border."""
    grid = places.flip(1)[None, None].to(covariances.dtype)  # (x, y)
    sampled = functional.grid_sample(covariances, grid, mode="bilinear", padding_mode="reflection", align_corners=False)
    return sampled[0, :, 0].T.double()
