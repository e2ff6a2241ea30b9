"""Matches between pairs of views, joined to tracks: one place in each of several views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from modp_ti.trackers.features import Matches

__all__ = ["feature_tracks"]


def feature_tracks(
    pixels: Sequence[NDArray[np.float64]], matches: Sequence[tuple[int, int, Matches]]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """View, feature and track number, (M,) each, of every feature that belongs to a track.

    pixels: (N, 2) per view. matches: (view a, view b, their matches). The clearest matches are joined first,
    and one that would put two places of a view into one track is left out: it is wrong, or one before it was,
    and the clearer is the better guess. SIFT gives a place several features where its direction is unclear;
    they count as the first of them.
    """
    offset = np.concatenate([[0], np.cumsum([len(each) for each in pixels])]).astype(np.int64)
    place = np.arange(offset[-1])
    for i, each in enumerate(pixels):
        if len(each):
            _, first, same = np.unique(each, axis=0, return_index=True, return_inverse=True)
            place[offset[i] : offset[i + 1]] = offset[i] + first[same.reshape(-1)]

    joined = [place[found.pairs + offset[[a, b]]] for a, b, found in matches]
    if not joined:
        return (np.zeros(0, dtype=np.int64),) * 3
    clearest = np.argsort(np.concatenate([found.ratio for _, _, found in matches]), kind="stable")
    nodes = np.unique(np.concatenate(joined))
    frame = np.searchsorted(offset, nodes, side="right") - 1
    links = np.searchsorted(nodes, np.concatenate(joined)[clearest])

    parent = list(range(len(nodes)))
    views = [1 << int(i) for i in frame]  # bit i: the track has a place in view i

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    for one, other in links.tolist():
        first, second = sorted((root(one), root(other)))
        if first != second and not views[first] & views[second]:
            parent[second] = first
            views[first] |= views[second]

    roots = np.array([root(node) for node in range(len(nodes))], dtype=np.int64)
    _, track, size = np.unique(roots, return_inverse=True, return_counts=True)
    track = track.reshape(-1)
    kept = size[track] >= 2
    _, track = np.unique(track[kept], return_inverse=True)
    return frame[kept], nodes[kept] - offset[frame[kept]], track.reshape(-1)
