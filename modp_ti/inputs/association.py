"""Association of two lists of times, for example of images and poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["MAX_DIFFERENCE", "associate"]

MAX_DIFFERENCE = 0.02
"""Largest time difference of a pair [s], as in the TUM benchmark."""

# Above MANY_PAIRS candidate pairs, only the NEAREST candidates on each side of a time are compared, to bound memory.
MANY_PAIRS = 4_000_000
NEAREST = 64


def associate(times_a: ArrayLike, times_b: ArrayLike, max_difference: float = MAX_DIFFERENCE) -> NDArray[np.int64]:
    """Associate two lists of times greedily: the pair with the smallest difference is taken first.

    Each time is in at most one pair. If two differences are equal, the pair with the lower indices is taken first.

    Args:
        times_a: Times (N,) [s], in any order.
        times_b: Times (K,) [s], in any order.
        max_difference: Largest difference of a pair [s].

    Returns:
        Pairs (M, 2) of indices into `times_a` and `times_b`, sorted by the first.

    Raises:
        ValueError: If a time is not finite.
    """
    a, b = np.asarray(times_a, dtype=np.float64).ravel(), np.asarray(times_b, dtype=np.float64).ravel()
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("time stamps must be finite numbers")
    order = np.argsort(b, kind="stable")
    first = np.searchsorted(b[order], a - max_difference, side="left")
    behind = np.searchsorted(b[order], a + max_difference, side="right")
    if (behind - first).sum() > MANY_PAIRS:
        at = np.searchsorted(b[order], a)
        first, behind = np.maximum(first, at - NEAREST), np.minimum(behind, at + NEAREST)
    count = np.maximum(behind - first, 0)
    # All candidate pairs: entry i of a with order[first[i]], order[first[i] + 1], ...
    of_a = np.repeat(np.arange(len(a)), count)
    step = np.arange(len(of_a)) - np.repeat(np.cumsum(count) - count, count)
    of_b = order[np.repeat(first, count) + step]

    free_a, free_b = np.ones(len(a), dtype=bool), np.ones(len(b), dtype=bool)
    pairs = []
    for k in np.lexsort((of_b, of_a, np.abs(a[of_a] - b[of_b]))):
        i, j = of_a[k], of_b[k]
        if free_a[i] and free_b[j]:
            free_a[i] = free_b[j] = False
            pairs.append((i, j))
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)
