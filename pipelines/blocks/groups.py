"""Grouping keyframes so that what each group sees fits into the pool."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["grouped"]

# Keyframes are at another place if the earlier ones of their group see at most this share of the Gaussians that they
# see. Groups are optimised one after the other, and what they share suits the last one best: a copy of redkitchen had
# 0.16 dB less when it was divided between two groups.
SHARED = 0.1


def grouped(seen: Iterable[NDArray[np.bool_]], counts: NDArray[np.int64], room: int) -> NDArray[np.int64]:
    """Group keyframes in order.

    A group ends before the keyframe with which it would see more than fits, or earlier, where it comes to a place that
    shares hardly any Gaussians with those before.

    Args:
        seen: For each of K keyframes, which blocks (B,) it sees.
        counts: Number (B,) of Gaussians of each block.
        room: Number of Gaussians that fit.

    Returns:
        Number (K,) of each keyframe's group, from 0 on. A keyframe that sees more than fits is alone.
    """
    sizes: list[int] = []  # of the groups that have ended
    rows: list[NDArray[np.bool_]] = []  # of the group that has not
    together = np.zeros(len(counts), dtype=bool)
    for row in seen:
        while rows and counts[together | row].sum() > room:
            sizes.append(_end(rows, counts))
            rows = rows[sizes[-1] :]
            together = np.any(rows, axis=0) if rows else np.zeros_like(together)
        rows.append(row)
        together |= row
    sizes += [len(rows)] if rows else []
    return np.repeat(np.arange(len(sizes)), sizes)


def _end(rows: Sequence[NDArray[np.bool_]], counts: NDArray[np.int64]) -> int:
    """Return how many of a group's keyframes (K, B) stay in it: all, or those before it comes to another place."""
    before, after = np.logical_or.accumulate(rows), np.logical_or.accumulate(rows[::-1])[::-1]
    shares = [counts[a & b].sum() / max(counts[b].sum(), 1) for a, b in zip(before[:-1], after[1:], strict=True)]
    if shares and min(shares) <= SHARED:
        return shares.index(min(shares)) + 1
    return len(rows)
