"""Helpers of the compressed splat formats: opacities, unit quaternions and quantisation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

__all__ = ["opacities", "smallest_three", "to_bits", "unit_quaternions"]


def opacities(state: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Return the opacity (N,) of every Gaussian, in (0, 1)."""
    return 1.0 / (1.0 + np.exp(-state["opacity_logit"].astype(np.float64)))


def unit_quaternions(state: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Return the rotations (N, 4) as unit quaternions w, x, y, z."""
    q = state["quaternion"].astype(np.float64)
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def smallest_three(q: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Split unit quaternions (N, 4) into the index of the largest component (N,) and the other three (N, 3), in order.

    The sign is chosen such that the largest component is positive and need not be stored.
    """
    largest = np.abs(q).argmax(axis=1)
    rows = np.arange(len(q))
    q = q * np.where(q[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = q[np.arange(4) != largest[:, None]].reshape(-1, 3)
    return largest, others


def to_bits(values: NDArray, bits: int) -> NDArray[np.uint32]:
    """Quantise values in [0, 1], after clipping, to the nearest of the levels 0 to 2^bits - 1."""
    most = (1 << bits) - 1
    return np.round(np.clip(values, 0.0, 1.0) * most).astype(np.uint32)
