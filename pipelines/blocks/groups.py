"""Grouping keyframes so that what each group sees fits into the pool."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

__all__ = ["grouped"]


def grouped(seen: Iterable[NDArray[np.bool_]], counts: NDArray[np.int64], room: int) -> NDArray[np.int64]:
    """Group keyframes in order. A group ends before the keyframe with which it would see more than fits.

    Args:
        seen: For each of K keyframes, which blocks (B,) it sees.
        counts: Number (B,) of Gaussians of each block.
        room: Number of Gaussians that fit.

    Returns:
        Number (K,) of each keyframe's group, from 0 on. A keyframe that sees more than fits is alone.
    """
    groups: list[int] = []
    together = np.zeros(len(counts), dtype=bool)
    for row in seen:
        if groups and counts[together | row].sum() > room:
            groups.append(groups[-1] + 1)
            together = row.copy()
        else:
            groups.append(groups[-1] if groups else 0)
            together |= row
    return np.array(groups, dtype=np.int64)
