"""Feature tracks from pairwise matches, with at most one feature per view in each track."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.multiview.features import Matches

__all__ = ["feature_tracks"]


def feature_tracks(
    pixels: Sequence[NDArray[np.float64]],
    matches: Sequence[tuple[int, int, Matches]],
    aside: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Join pairwise matches to tracks.

    Matches are joined in the order of their ratio, most distinctive first. A match that would put two positions of one
    view into a track is dropped: either it or an earlier one is wrong, and the more distinctive one is more likely
    right. SIFT detects several features at one position if the orientation is ambiguous; they count as the first one.

    Args:
        pixels: (N, 2) features of each view.
        matches: (view a, view b, their matches).
        aside: (views,) True for held-out views. They neither start nor join tracks, but their features are added to the
            tracks of the other views.

    Returns:
        View, feature and track, (M,) each, of every feature that belongs to a track.
    """
    if aside is None:
        aside = np.zeros(len(pixels), dtype=bool)
    # Matches between two held-out views must not create tracks.
    matches = [each for each in matches if not (aside[each[0]] and aside[each[1]])]
    offset = np.concatenate([[0], np.cumsum([len(each) for each in pixels])]).astype(np.int64)
    place = np.arange(offset[-1])
    for i, each in enumerate(pixels):
        if len(each):
            _, first, same = np.unique(each, axis=0, return_index=True, return_inverse=True)
            place[offset[i] : offset[i + 1]] = offset[i] + first[same.reshape(-1)]

    joined = [place[found.pairs + offset[[a, b]]] for a, b, found in matches]
    if not joined:
        nothing = np.zeros(0, dtype=np.int64)
        return nothing, nothing, nothing
    late = np.concatenate([np.full(len(found), aside[a] or aside[b]) for a, b, found in matches])
    clearest = np.lexsort((np.concatenate([found.ratio for _, _, found in matches]), late))
    nodes = np.unique(np.concatenate(joined))
    frame = np.searchsorted(offset, nodes, side="right") - 1
    links = np.searchsorted(nodes, np.concatenate(joined)[clearest])

    alone = aside[frame].tolist()  # nodes of held-out views, which must not join other tracks
    parent = list(range(len(nodes)))
    views = [1 << int(i) for i in frame]  # bit i: the track has a feature in view i

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    for one, other in links.tolist():
        if alone[one] or alone[other]:
            leaf, stem = (one, root(other)) if alone[one] else (other, root(one))
            if parent[leaf] == leaf and not views[stem] & views[leaf]:
                parent[leaf] = stem
                views[stem] |= views[leaf]
            continue
        first, second = sorted((root(one), root(other)))
        if first != second and not views[first] & views[second]:
            parent[second] = first
            views[first] |= views[second]

    roots = np.array([root(node) for node in range(len(nodes))], dtype=np.int64)
    kept = np.bincount(roots[~aside[frame]], minlength=len(nodes))[roots] >= 2
    _, track = np.unique(roots[kept], return_inverse=True)
    return frame[kept], nodes[kept] - offset[frame[kept]], track.reshape(-1)
