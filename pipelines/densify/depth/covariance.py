"""Covariance functions of Gaussian processes over the image plane, in PyTorch."""

from __future__ import annotations

import numpy as np
import torch

__all__ = ["matern32", "nonstationary_matern32", "nonstationary_variance"]

EPSILON = 1e-8


def matern32(distance: torch.Tensor) -> torch.Tensor:
    """Matern 3/2 correlation at `distance`, in units of the length scale."""
    r = np.sqrt(3.0) * distance
    return (1.0 + r) * torch.exp(-r)


def nonstationary_matern32(p: torch.Tensor, E: torch.Tensor, q: torch.Tensor, F: torch.Tensor) -> torch.Tensor:
    """Correlation of a non-stationary Matern 3/2 process [Paciorek 2003; Dexheimer 2023].

    The correlation is C (1 + r) exp(-r) with d = p - q, S = E + F, Q = d' S^-1 d / 2, r = sqrt(3 (Q + eps)),
    C = 2 (|E| |F|)^(1/4) / sqrt(|S| + eps) and eps = 1e-8. Where the covariances vary slowly, it approaches the
    stationary Matern process that they describe.

    Args:
        p: Points (N, 2).
        E: Covariances (N, 3) at p as (xx, xy, yy), positive definite, with the axes of p.
        q: Points (M, 2).
        F: Covariances (M, 3) at q, likewise.

    Returns:
        Correlation (N, M).
    """
    d = p[:, None] - q[None]
    S = E[:, None] + F[None]
    det = _determinant(S)
    Q = 0.5 * (S[..., 2] * d[..., 0] ** 2 - 2.0 * S[..., 1] * d[..., 0] * d[..., 1] + S[..., 0] * d[..., 1] ** 2) / det
    C = 2.0 * (_determinant(E)[:, None] * _determinant(F)[None]) ** 0.25 / torch.sqrt(det + EPSILON)
    return C * matern32(torch.sqrt(Q + EPSILON))


def nonstationary_variance(E: torch.Tensor) -> torch.Tensor:
    """Diagonal (N,) of `nonstationary_matern32`(p, E, p, E), which is 1 except for eps."""
    det = _determinant(E)
    C = 2.0 * torch.sqrt(det) / torch.sqrt(4.0 * det + EPSILON)
    return C * matern32(torch.full_like(det, EPSILON).sqrt())


def _determinant(A: torch.Tensor) -> torch.Tensor:
    return A[..., 0] * A[..., 2] - A[..., 1] ** 2
