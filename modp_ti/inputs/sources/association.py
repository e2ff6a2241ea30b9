"""Which entries of two lists of time stamps belong together: the nearest-time association of the TUM tools."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["MAX_DIFFERENCE", "associate"]

MAX_DIFFERENCE = 0.02
"""Seconds by which the TUM benchmark lets the times of a pair differ."""


# Pairs within reach up to which all are compared, and how many to each side of a time are beyond.
MANY_PAIRS = 4_000_000
NEAREST = 64


def associate(times_a: ArrayLike, times_b: ArrayLike, max_difference: float = MAX_DIFFERENCE) -> NDArray[np.int64]:
    """Pairs (M, 2) of places in `times_a` (N,) and `times_b` (K,), increasing in the first.

    Times in seconds, in any order. No pair differs by more than `max_difference`, nothing is in two pairs, and of all
    pairs that are left the one with the smallest difference is taken next (the earlier places where two are equal).
    Raises ValueError for a time that is not finite.
    """
    a, b = np.asarray(times_a, dtype=np.float64).ravel(), np.asarray(times_b, dtype=np.float64).ravel()
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("time stamps must be finite numbers")
    order = np.argsort(b, kind="stable")
    first = np.searchsorted(b[order], a - max_difference, side="left")
    behind = np.searchsorted(b[order], a + max_difference, side="right")
    if (behind - first).sum() > MANY_PAIRS:  # such times would take all memory: the nearest ones of each will do
        at = np.searchsorted(b[order], a)
        first, behind = np.maximum(first, at - NEAREST), np.minimum(behind, at + NEAREST)
    count = np.maximum(behind - first, 0)
    # All pairs within reach: entry i of a with order[first[i]], order[first[i] + 1], ...
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
