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
    place = _first_at_position(pixels, offset)

    joined = [place[found.pairs + offset[[a, b]]] for a, b, found in matches]
    if not joined:
        nothing = np.zeros(0, dtype=np.int64)
        return nothing, nothing, nothing
    late = np.concatenate([np.full(len(found), aside[a] or aside[b]) for a, b, found in matches])
    clearest = np.lexsort((np.concatenate([found.ratio for _, _, found in matches]), late))
    nodes = np.unique(np.concatenate(joined))
    frame = np.searchsorted(offset, nodes, side="right") - 1
    links = np.searchsorted(nodes, np.concatenate(joined)[clearest])

    roots = _roots(frame, links, aside[frame])
    kept = np.bincount(roots[~aside[frame]], minlength=len(nodes))[roots] >= 2
    _, track = np.unique(roots[kept], return_inverse=True)
    return frame[kept], nodes[kept] - offset[frame[kept]], track.reshape(-1)


def _first_at_position(pixels: Sequence[NDArray[np.float64]], offset: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each feature of all views, the first feature of its view at the same position.

    Args:
        pixels: (N, 2) features of each view.
        offset: Number of the first feature of each view, and of all features at the end.
    """
    place = np.arange(offset[-1])
    for i, each in enumerate(pixels):
        if len(each):
            _, first, same = np.unique(each, axis=0, return_index=True, return_inverse=True)
            place[offset[i] : offset[i + 1]] = offset[i] + first[same.reshape(-1)]
    return place


def _roots(frame: NDArray[np.int64], links: NDArray[np.int64], held_out: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Join nodes by their links in order (union-find), except where a track would get two nodes of one view.

    Args:
        frame: (N,) view of each node.
        links: (M, 2) pairs of nodes.
        held_out: (N,) nodes of held-out views. Each may be added to one track but joins no two tracks.

    Returns:
        The root node (N,) of each node's track.
    """
    alone = held_out.tolist()
    parent = list(range(len(frame)))
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
    return np.array([root(node) for node in range(len(frame))], dtype=np.int64)
