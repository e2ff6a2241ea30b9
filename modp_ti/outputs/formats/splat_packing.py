"""Quantisation that the formats of compressed splats share."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

# A rotation by 180 degrees around x, to axes with y up: of positions, and of the harmonics of degree 1, 2 and 3, of
# which those that are odd in (y, z) change their sign.
HALF_TURN = np.array([1.0, -1.0, -1.0])
TURNED = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], dtype=np.float64)


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


def packed(parts: NDArray[np.float64] | list[NDArray[np.float64]], bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """Pack numbers in [0, 1] into one word with the given bits each, the first in the highest bits."""
    word = np.zeros(len(parts[0]), np.uint32)
    for part, count in zip(parts, bits, strict=True):
        word = word << np.uint32(count) | to_bits(part, count)
    return word


def morton_order(position: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the order (N,) along a Morton curve with 10 bits per coordinate."""
    if len(position) == 0:
        return np.zeros(0, np.int64)
    low, high = position.min(axis=0), position.max(axis=0)
    cell = to_bits((position - low) / np.maximum(high - low, 1e-12), 10).astype(np.uint64)
    key = np.zeros(len(position), np.uint64)
    for bit in range(10):
        for axis in range(3):
            key |= (cell[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(key, kind="stable")
