"""Depth of pixels that no tracked point covers (Section 3.2.2, high error regions)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from fields.keyframes import Keyframe
from pipelines.settings import DepthSettings

__all__ = ["DepthEstimate", "DepthEstimator", "GaussianProcessDepth", "matern32"]


@dataclass(frozen=True)
class DepthEstimate:
    """depth (N,) [scene units] and the standard deviation of its logarithm (N,), of N pixels."""

    depth: NDArray[np.float64]
    deviation: NDArray[np.float64]


class DepthEstimator(Protocol):
    """Estimates depth where it is asked for."""

    def estimate(self, view: Keyframe, pixels: NDArray[np.float64]) -> DepthEstimate:
        """Depth of the pixels (N, 2) as (x, y) of `view`; infinite deviation where nothing is known."""


def matern32(distance: torch.Tensor) -> torch.Tensor:
    """Matern 3/2 correlation of distances in units of the length scale."""
    r = np.sqrt(3.0) * distance
    return (1.0 + r) * torch.exp(-r)


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

    def estimate(self, view: Keyframe, pixels: NDArray[np.float64]) -> DepthEstimate:
        z = view.points.xyz @ view.T_camera_world[2, :3] + view.T_camera_world[2, 3]
        usable = np.flatnonzero((z > 0) & view.camera.contains(view.points.pixels))
        if len(usable) > self.settings.max_points:
            usable = np.sort(self._rng.choice(usable, self.settings.max_points, replace=False))
        if len(usable) < 3 or len(pixels) == 0:
            return DepthEstimate(np.ones(len(pixels)), np.full(len(pixels), np.inf))
        side = max(view.camera.width, view.camera.height)
        known = torch.from_numpy(view.points.pixels[usable] / side)
        asked = torch.from_numpy(np.asarray(pixels, dtype=np.float64) / side)
        y = torch.from_numpy(np.log(z[usable]))
        mean = y.mean()
        some = slice(None, None, max(len(y) // self.FIT_POINTS, 1))
        length, ratio, variance = self._fit(known[some], (y - mean)[some])
        K = matern32(torch.cdist(known, known) / length)
        L = torch.linalg.cholesky(K + ratio * torch.eye(len(y), dtype=torch.float64))
        k = matern32(torch.cdist(asked, known) / length)
        log_depth = mean + k @ torch.cholesky_solve((y - mean)[:, None], L)[:, 0]
        half = torch.linalg.solve_triangular(L, k.T, upper=False)
        deviation = torch.sqrt(variance * (1.0 - (half * half).sum(0)).clamp_min(0.0))
        return DepthEstimate(torch.exp(log_depth).numpy(), deviation.numpy())

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
