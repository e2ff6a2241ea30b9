"""SIFT features, their matches between two views, and their tracks through many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MAX_SIDE = 1000
MAX_FEATURES = 2000
RATIO = 0.8
CONTRAST = 0.02
FLOW_WINDOW = (21, 21)  # px

# Descriptors are integers whose norm is at most this number. Their float32 dot products are exact, so that matches do
# not depend on how a matrix product is split over threads.
DESCRIPTOR_NORM = 512


@dataclass(frozen=True)
class Features:
    """Features of one image.

    Attributes:
        pixels: (N, 2) in the stored image, with pixel centres at +0.5.
        descriptors: (N, 128) uint8.
        pixel: Pixel size of the resized image used for detection, in pixels of the stored image.
    """

    pixels: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    pixel: float

    def within(self, valid: NDArray[np.bool_] | None) -> Features:
        """Select the features at valid pixels (H, W) of the stored image; None for all."""
        if valid is None:
            return self
        height, width = valid.shape
        column, row = np.minimum(np.floor(self.pixels).astype(int), [width - 1, height - 1]).T
        kept = valid[row, column]
        return Features(self.pixels[kept], self.descriptors[kept], self.pixel)


Matches = tuple[NDArray[np.int64], NDArray[np.floating]]
"""Matches between two views: indices (M, 2) of the features in both, and the ratio (M,) of the squared descriptor
distance to that of the second-best match; smaller is more distinctive."""


def detect_features(image: NDArray[np.uint8], most: int = MAX_FEATURES, side: int = MAX_SIDE) -> Features:
    """Detect SIFT features with RootSIFT descriptors.

    Args:
        image: (H, W, 3) uint8 RGB.
        most: Number of features, the strongest ones.
        side: A longer side of the image is reduced to this [px].
    """
    import cv2

    grey, pixel, to_stored = shrunk_grey(image, side)
    # Without the precise upscale, all keypoints are shifted by a quarter of a pixel to the right and down.
    sift = cv2.SIFT.create(nfeatures=most, contrastThreshold=CONTRAST, enable_precise_upscale=True)
    keypoints, raw = sift.detectAndCompute(grey, None)
    if raw is None or len(keypoints) == 0:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8), pixel)

    # In cv2 the first pixel's centre is 0.
    places = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64)
    pixels = (places + 0.5) * to_stored
    raw = raw.astype(np.float64)
    root = np.sqrt(raw / np.maximum(raw.sum(axis=1, keepdims=True), 1e-12))  # RootSIFT
    descriptors = np.clip(np.floor(DESCRIPTOR_NORM * root), 0, 255).astype(np.uint8)
    return Features(pixels, descriptors, pixel)


def shrunk_grey(image: NDArray[np.uint8], most: int) -> tuple[NDArray[np.uint8], float, NDArray[np.float64]]:
    """Convert an image (H, W, 3) uint8 RGB to grey, and reduce a longer side above `most` px to that.

    Returns:
        The grey image, the size of its pixels in pixels of the image, and the exact ratios (2,) of widths and heights.
    """
    import cv2

    height, width = image.shape[:2]
    pixel = max(1.0, max(height, width) / most)
    size = (max(1, round(width / pixel)), max(1, round(height / pixel)))
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if size != (width, height):
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.asarray(grey, np.uint8), pixel, np.divide((width, height), size)


def flow_there_and_back(
    one: NDArray[np.uint8],
    other: NDArray[np.uint8],
    start: NDArray[np.float32],
    guess: NDArray[np.float32],
    levels: int,
    return_levels: int,
) -> tuple[NDArray[np.float32], NDArray[np.floating]]:
    """Track points by pyramidal Lucas-Kanade to another image and back.

    Args:
        one: (H, W) uint8.
        other: (H, W) uint8.
        start: (N, 1, 2) points in `one`, in cv2's pixels (first centre at 0).
        guess: (N, 1, 2) their expected positions in `other`.
        levels: Pyramid levels above the image.
        return_levels: Those on the way back, which starts where it should end.

    Returns:
        Positions (N, 1, 2) in `other`, and the distances (N,) [px] from the start after the way back; infinite where a
        point was lost.
    """
    import cv2

    options = {
        "winSize": FLOW_WINDOW,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02),
    }
    there, found, _ = cv2.calcOpticalFlowPyrLK(one, other, start, guess.copy(), maxLevel=levels, **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(other, one, there, start.copy(), maxLevel=return_levels, **options)
    there = np.asarray(there, np.float32)
    found = (found[:, 0] > 0) & (returned[:, 0] > 0) & np.isfinite(there).all(axis=(1, 2))
    return there, np.where(found, np.linalg.norm(back - start, axis=(1, 2)), np.inf)


def essential_matrix(T_a_world: NDArray[np.float64], T_b_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Essential matrix E (3, 3) with x_b^T E x_a = 0 for normalised coordinates x_a, x_b of a point in two views.

    Args:
        T_a_world: (4, 4) pose of the first view.
        T_b_world: (4, 4) pose of the second view.
    """
    T_b_a = T_b_world @ np.linalg.inv(T_a_world)
    x, y, z = T_b_a[:3, 3]
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ T_b_a[:3, :3]


def match_anywhere(a: Features, b: Features) -> NDArray[np.int64]:
    """Pairs (M, 2) of mutual best matches between two images that pass the ratio test, wherever they are."""
    nowhere = np.zeros((3, 3))  # a zero essential matrix accepts all positions
    return match_features(a.descriptors, b.descriptors, a.pixels, b.pixels, nowhere, 1.0)[0]


def epipolar_lines(essential: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lines (N, 3) in view b, with normals of length 1, of normalised coordinates (N, 2) in view a.

    Without camera motion there is no line: all are 0.
    """
    lines = np.c_[rays, np.ones(len(rays))] @ essential.T
    return lines / np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)


def match_features(
    descriptors_a: NDArray[np.uint8],
    descriptors_b: NDArray[np.uint8],
    rays_a: NDArray[np.float64],
    rays_b: NDArray[np.float64],
    essential: NDArray[np.float64],
    band: float,
) -> Matches:
    """Find mutual best matches near the epipolar line that pass the ratio test.

    Args:
        descriptors_a: (Na, 128) uint8.
        descriptors_b: (Nb, 128) uint8.
        rays_a: (Na, 2) normalised coordinates.
        rays_b: (Nb, 2) normalised coordinates.
        essential: (3, 3) essential matrix from a to b.
        band: Largest distance from the epipolar line in view b, in normalised coordinates (pixels / focal length).
    """
    if len(descriptors_a) < 2 or len(descriptors_b) < 2:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    a, b = descriptors_a.astype(np.float32), descriptors_b.astype(np.float32)
    similarity = a @ b.T
    off = epipolar_lines(essential, rays_a).astype(np.float32) @ np.c_[rays_b, np.ones(len(rays_b))].T.astype(
        np.float32
    )
    similarity[~(np.abs(off) <= band)] = -1.0  # written so that NaN, where the lens model has no ray, is excluded

    # First the mutual best matches, by passes over whole rows. The second best is needed only for these few.
    row = np.arange(len(a))
    best_b = similarity.argmax(axis=1)
    top = similarity[row, best_b]
    mutual = (top > 0) & (top == similarity.max(axis=0)[best_b])
    row, best_b, top = row[mutual], best_b[mutual], top[mutual]
    rows, columns = similarity[row], np.ascontiguousarray(similarity[:, best_b].T)
    rows[np.arange(len(row)), best_b] = -1.0
    columns[np.arange(len(row)), row] = -1.0
    norm_a, norm_b = (a * a).sum(axis=1), (b * b).sum(axis=1)
    second_b, second_a = rows.argmax(axis=1), columns.argmax(axis=1)
    square = norm_a[row] + norm_b[best_b] - 2 * top
    square_b = norm_a[row] + norm_b[second_b] - 2 * rows[np.arange(len(row)), second_b]
    square_a = norm_a[second_a] + norm_b[best_b] - 2 * columns[np.arange(len(row)), second_a]
    ratio = square / np.maximum(np.minimum(square_a, square_b), 1.0)
    clear = ratio < RATIO**2
    return np.stack([row[clear], best_b[clear]], axis=1), ratio[clear]


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

    joined = [place[pairs + offset[[a, b]]] for a, b, (pairs, _) in matches]
    if not joined:
        nothing = np.zeros(0, dtype=np.int64)
        return nothing, nothing, nothing
    late = np.concatenate([np.full(len(pairs), aside[a] or aside[b]) for a, b, (pairs, _) in matches])
    clearest = np.lexsort((np.concatenate([ratio for _, _, (_, ratio) in matches]), late))
    nodes = np.unique(np.concatenate(joined))
    frame = np.searchsorted(offset, nodes, side="right") - 1
    links = np.searchsorted(nodes, np.concatenate(joined)[clearest])

    roots = _roots(frame, links, aside[frame])
    kept = np.bincount(roots[~aside[frame]], minlength=len(nodes))[roots] >= 2
    _, track = np.unique(roots[kept], return_inverse=True)
    return frame[kept], nodes[kept] - offset[frame[kept]], track.reshape(-1)


def _first_at_position(pixels: Sequence[NDArray[np.float64]], offset: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each feature of all views, the first of its view at the same position; views begin at `offset`."""
    place = np.arange(offset[-1])
    for i, each in enumerate(pixels):
        if len(each):
            _, first, same = np.unique(each, axis=0, return_index=True, return_inverse=True)
            place[offset[i] : offset[i + 1]] = offset[i] + first[same.reshape(-1)]
    return place


def _roots(frame: NDArray[np.int64], links: NDArray[np.int64], held_out: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Roots (N,) of tracks of nodes, joined by links (M, 2) in order, except where a view would get two nodes in one.

    Each node of a held-out view (N,) may be added to one track but joins no two tracks.
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
