"""`merged`: one Gaussian for each cell of a grid, with the moments of those inside."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import matrices_from_unit_quaternions, quaternions_from_matrices

__all__ = ["merged"]

# Largest opacity of a merged Gaussian.
MOST_OPAQUE = 0.99
# Only Gaussians whose largest standard deviation is at most this share of a cell's side are merged.
LARGEST = 0.5


def merged(state: Mapping[str, NDArray], group: NDArray[np.integer], side: float) -> tuple[dict[str, NDArray], NDArray]:
    """Replace the small Gaussians of each group and cell by one that has their moments.

    A Gaussian i with covariance S_i, opacity o_i and mean m_i counts by its weight w_i = o_i a_i, where

        a_i = sqrt((tr(S_i)^2 - tr(S_i^2)) / 2)

    is proportional to the root of the mean square of the areas that it covers when seen from all directions. The merged
    Gaussian has the weighted mean m of the positions, the weighted means of all harmonics, and the covariance

        S = sum w_i (S_i + (m_i - m)(m_i - m)^T) / sum w_i

    Its opacity o = sum w_i / a keeps the total of opacity times area, up to `MOST_OPAQUE`. A Gaussian that is alone in
    its cell, or too large to be merged, stays as it is.

    Args:
        state: N Gaussians by name, as from `GaussianField.to_numpy`.
        group: Group (N,) of each Gaussian, in increasing order. Gaussians of different groups are not merged.
        side: Side of the cells [scene units]. The origin of the world is a corner of one.

    Returns:
        The M merged Gaussians, ordered by group, and their groups (M,).
    """
    position, log_scale = state["position"].astype(np.float64), state["log_scale"].astype(np.float64)
    cell = np.floor(position / side).astype(np.int64)
    # Gaussians that are too large get cells of their own: by their place plus one, where it is 0 for all others.
    alone = np.where(np.exp(log_scale.max(axis=1)) > LARGEST * side, np.arange(len(position)) + 1, 0)
    key = np.column_stack([group, cell, alone])
    order = np.lexsort(key.T[::-1])  # stable: equal cells keep their order
    changes = (np.diff(key[order], axis=0) != 0).any(axis=1)
    first = np.flatnonzero(np.concatenate([[True], changes])) if len(order) else np.zeros(0, np.int64)
    result = {name: array[order[first]] for name, array in state.items()}
    count = np.diff(np.append(first, len(order)))
    several = np.flatnonzero(count > 1)
    if len(several):
        members = order[np.repeat(count > 1, count)]
        parts = {name: array[members].astype(np.float64) for name, array in state.items()}
        begin = np.append(0, np.cumsum(count[several])[:-1])
        for name, array in _moments(parts, begin).items():
            result[name][several] = array
    return result, group[order[first]]


def _moments(state: dict[str, NDArray[np.float64]], first: NDArray[np.integer]) -> dict[str, NDArray[np.float64]]:
    """Merge consecutive runs of Gaussians, which begin at `first`."""
    q = state["quaternion"]
    R = matrices_from_unit_quaternions(q / np.linalg.norm(q, axis=1, keepdims=True))
    M = R * np.exp(state["log_scale"])[:, None, :]
    S = M @ M.transpose(0, 2, 1)
    weight = _area(S) / (1.0 + np.exp(-state["opacity_logit"]))
    count = np.diff(np.append(first, len(weight)))
    total = np.add.reduceat(weight, first)
    share = weight / np.repeat(total, count)
    mean = np.add.reduceat(share[:, None] * state["position"], first)
    offset = state["position"] - np.repeat(mean, count, axis=0)
    S = np.add.reduceat(share[:, None, None] * (S + offset[:, :, None] * offset[:, None, :]), first)
    opacity = np.minimum(total / _area(S), MOST_OPAQUE)
    variance, axes = np.linalg.eigh(S)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    return {
        "position": mean,
        "log_scale": 0.5 * np.log(np.maximum(variance, 1e-12 * variance[:, 2:])),
        "quaternion": quaternions_from_matrices(axes),
        "opacity_logit": np.log(opacity) - np.log1p(-opacity),
        "sh": np.add.reduceat(share[:, None, None] * state["sh"], first),
    }


def _area(S: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the measure (N,) of the areas of covariances (N, 3, 3); see `merged`."""
    trace = np.trace(S, axis1=1, axis2=2)
    return np.sqrt(np.maximum(0.5 * (trace**2 - np.einsum("nij,nij->n", S, S)), 1e-300))
