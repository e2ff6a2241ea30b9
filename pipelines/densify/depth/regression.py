"""Gaussian process regression of log depth on tracked points, for any kernel."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from fields.map.keyframe import Keyframe
from pipelines.densify.depth.estimate import DepthEstimate, point_depths

__all__ = ["MIN_POINTS", "conditioning_points", "regress_log_depth"]

# Minimum number of points to condition a process on. Fewer contain no information about the shape of the scene.
MIN_POINTS = 3


def conditioning_points(
    view: Keyframe, max_points: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Select tracked points to condition a process on.

    Args:
        view: The view.
        max_points: Maximum number of points. If there are more, a random subset is used.
        rng: Random generator.

    Returns:
        Pixels (M, 2) and depths (M,) of the points.
    """
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
    """Predict depth at N points from M known depths, by the covariances of a process on log depth (float64).

    With y the known log depths and mu their mean (Section 3.2.2; Dexheimer 2023):
    mean = mu + k (K + noise I)^-1 (y - mu), variance = prior - diag(k (K + noise I)^-1 k'), depth = exp(mean).

    Args:
        depth: Known depths (M,), positive.
        K: Covariance (M, M) of the known points.
        noise: Noise variance of the known log depths.
        k: Covariance (N, M) between the predicted and the known points.
        prior: Prior variance of the predicted points, (N,) or a scalar.

    Returns:
        Depth (N,) and deviation (N,).
    """
    y = torch.from_numpy(np.log(depth))
    mu = y.mean()
    L = torch.linalg.cholesky(K + noise * torch.eye(len(y), dtype=K.dtype))
    mean = mu + k @ torch.cholesky_solve((y - mu)[:, None], L)[:, 0]
    half = torch.linalg.solve_triangular(L, k.T, upper=False)
    variance = prior - (half * half).sum(0)
    return DepthEstimate(torch.exp(mean).numpy(), variance.clamp_min(0.0).sqrt().numpy())
