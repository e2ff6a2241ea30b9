"""Kernels of Gaussian processes over the image plane, in torch."""

from __future__ import annotations

import numpy as np
import torch

__all__ = ["matern32", "nonstationary_matern32", "nonstationary_variance"]

EPSILON = 1e-8


def matern32(distance: torch.Tensor) -> torch.Tensor:
    """Matern 3/2 correlation of distances in units of the length scale."""
    r = np.sqrt(3.0) * distance
    return (1.0 + r) * torch.exp(-r)


def nonstationary_matern32(p: torch.Tensor, E: torch.Tensor, q: torch.Tensor, F: torch.Tensor) -> torch.Tensor:
    """Correlation (N, M) of places p (N, 2) and q (M, 2) with covariances E (N, 3), F (M, 3) as (xx, xy, yy).

    C (1 + r) exp(-r) with S = E + F, Q = d' S^-1 d / 2, r = sqrt(3 (Q + eps)), C = 2 (|E| |F|)^(1/4) / sqrt(|S| + eps)
    and eps = 1e-8 [Paciorek 2003; Dexheimer 2023]: where the covariances change little it is the Matern process that
    they describe. The covariances must be positive definite, with their axes in the order of the places'.
    """
    d = p[:, None] - q[None]
    S = E[:, None] + F[None]
    det = _determinant(S)
    Q = 0.5 * (S[..., 2] * d[..., 0] ** 2 - 2.0 * S[..., 1] * d[..., 0] * d[..., 1] + S[..., 0] * d[..., 1] ** 2) / det
    C = 2.0 * (_determinant(E)[:, None] * _determinant(F)[None]) ** 0.25 / torch.sqrt(det + EPSILON)
    return C * matern32(torch.sqrt(Q + EPSILON))


def nonstationary_variance(E: torch.Tensor) -> torch.Tensor:
    """The diagonal (N,) of `nonstationary_matern32`(p, E, p, E), which is 1 but for eps."""
    det = _determinant(E)
    C = 2.0 * torch.sqrt(det) / torch.sqrt(4.0 * det + EPSILON)
    return C * matern32(torch.full_like(det, EPSILON).sqrt())


def _determinant(A: torch.Tensor) -> torch.Tensor:
    return A[..., 0] * A[..., 2] - A[..., 1] ** 2
