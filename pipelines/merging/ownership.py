"""Ownership: which of several overlapping maps the Gaussians of each place are taken from.

Space is divided into cubes. Every map gets a score in every cube: the number of pixels that its Gaussians there cover
in the keyframes that are its own, each Gaussian where it shows most. A cube belongs to the map with the highest score
in the cube and its 26 neighbours together, of those that show anything in the cube itself. The neighbours make the
border between two maps smooth, and the last condition leaves no hole where only one of them has seen something.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Shown", "owned"]

NEIGHBOURS = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
# Cubes farther from the origin than this are taken as one. Three such coordinates fit into 63 bits.
FARTHEST = (1 << 20) - 2


@dataclass(frozen=True)
class Shown:
    """How the own keyframes of a map show its Gaussians.

    Attributes:
        position: Positions (N, 3) in the world frame.
        coverage: Pixels (N,) that each covers where it shows most, see `Contribution`.
    """

    position: NDArray[np.floating]
    coverage: NDArray[np.floating]


def owned(maps: Sequence[Shown], edge: float) -> list[NDArray[np.bool_]]:
    """Return which Gaussians (N,) of each map lie in a cube of that map.

    Gaussians that do not show are not kept. Of equal scores, that of the first map counts.

    Args:
        maps: The maps.
        edge: Edge of a cube [scene units].
    """
    cubes = [_cubes(each.position, edge) for each in maps]
    keys, places = np.unique(_keys(np.concatenate(cubes)), return_inverse=True)
    at = np.split(places.reshape(-1), np.cumsum([len(each) for each in cubes])[:-1])
    owner, best = np.full(len(keys), -1), np.zeros(len(keys))
    for number, each in enumerate(maps):
        score = np.bincount(at[number], each.coverage, len(keys)).astype(np.float64)
        around = _around(keys, score)
        wins = (score > 0.0) & (around > best)
        owner[wins], best[wins] = number, around[wins]
    return [(owner[at[number]] == number) & (each.coverage > 0.0) for number, each in enumerate(maps)]


def _cubes(position: NDArray[np.floating], edge: float) -> NDArray[np.int64]:
    """Return the integer coordinates (N, 3) of the cubes of positions."""
    return np.floor(np.clip(position / edge, -FARTHEST, FARTHEST)).astype(np.int64)


def _keys(cubes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one number (N,) for each cube. Those of two cubes differ by a sum over their coordinates."""
    return cubes @ np.array([1 << 42, 1 << 21, 1])


def _around(keys: NDArray[np.int64], score: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sum (M,) of the scores of each cube and its neighbours, of those that are among the sorted `keys`."""
    total = np.zeros(len(keys))
    for step in _keys(NEIGHBOURS):
        there = np.minimum(np.searchsorted(keys, keys + step), len(keys) - 1)
        total += np.where(keys[there] == keys + step, score[there], 0.0)
    return total
