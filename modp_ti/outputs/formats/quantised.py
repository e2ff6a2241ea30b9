"""What the compressed forms of splats have in common: opacities, unit quaternions, and numbers in a few bits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

__all__ = ["opacities", "smallest_three", "to_bits", "unit_quaternions"]


def opacities(state: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Opacity in (0, 1) of every Gaussian (N,)."""
    return 1.0 / (1.0 + np.exp(-state["opacity_logit"].astype(np.float64)))


def unit_quaternions(state: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Rotations (N, 4) as w, x, y, z of length 1."""
    q = state["quaternion"].astype(np.float64)
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def smallest_three(q: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Place of the largest component (N,) of unit quaternions (N, 4), and the others (N, 3) in their order.

    Of q and -q, the same rotation, it takes the one whose largest component is positive, so that it need not be kept.
    """
    largest = np.abs(q).argmax(axis=1)
    rows = np.arange(len(q))
    q = q * np.where(q[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = q[np.arange(4) != largest[:, None]].reshape(-1, 3)
    return largest, others


def to_bits(values: NDArray, bits: int) -> NDArray[np.uint32]:
    """Values in [0, 1], clipped to it, as the nearest of 2^bits - 1 steps."""
    most = (1 << bits) - 1
    return np.round(np.clip(values, 0.0, 1.0) * most).astype(np.uint32)
