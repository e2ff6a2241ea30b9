"""Regression of log depth on tracked points: what every Gaussian process of this package shares but its kernel."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from fields.map.keyframes import Keyframe
from pipelines.densify.depth.estimate import DepthEstimate, point_depths

__all__ = ["MIN_POINTS", "conditioning_points", "regress_log_depth"]

# The least that a process is conditioned on: fewer say nothing of the scene's shape.
MIN_POINTS = 3


def conditioning_points(
    view: Keyframe, max_points: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (M, 2) and depths (M,) of the tracked points of `view`, of more than `max_points` a random choice."""
    places, z = point_depths(view)
    if len(z) > max_points:
        some = np.sort(rng.choice(len(z), max_points, replace=False))
        places, z = places[some], z[some]
    return places, z


def regress_log_depth(
    depth: NDArray[np.float64],
    K: torch.Tensor,
    noise: float,
    k: torch.Tensor,
    prior: torch.Tensor | float,
) -> DepthEstimate:
    """Depth at N places from `depth` (M,) > 0 at M others, by the covariances of a process on log depth [float64].

    K: (M, M) among the known places. noise: variance on its diagonal. k: (N, M) from asked to known. prior: variance
    (N,) of the asked ones. With y the log depths and mu their mean (Section 3.2.2; Dexheimer 2023):
    mean = mu + k (K + noise I)^-1 (y - mu), variance = prior - diag(k (K + noise I)^-1 k'), depth = exp(mean).
    """
    y = torch.from_numpy(np.log(depth))
    mu = y.mean()
    L = torch.linalg.cholesky(K + noise * torch.eye(len(y), dtype=K.dtype))
    mean = mu + k @ torch.cholesky_solve((y - mu)[:, None], L)[:, 0]
    half = torch.linalg.solve_triangular(L, k.T, upper=False)
    variance = prior - (half * half).sum(0)
    return DepthEstimate(torch.exp(mean).numpy(), variance.clamp_min(0.0).sqrt().numpy())
