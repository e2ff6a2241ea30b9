"""Depth of rendered views, corrected by matching the images of neighbouring frames.

A map is optimised for colour: where there is little texture, its Gaussians stay at the depth that they were given,
whole regions of them some percent off, and all views agree on it. The images hold the parallax all the same; so do,
less sharp, the map's own pictures. Around the depth that the map shows, inverse depths are swept [Collins 1996]:
every neighbour's image is carried over and compared (ZNCC); sums of matching cost along rows and columns decide
[Hirschmueller 2008], and the map where the images say nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3

__all__ = ["DepthView", "agreed_depth", "choose_neighbours", "matched_depth"]

# Neighbours a view is compared with: as many before and after it, half of them at each of these parallaxes (the
# baseline over the median depth), as near as there are.
PARALLAXES = (0.25, 0.12, 0.06)
NEIGHBOURS = 12
# No neighbour looks more than this away (cosine of the angle), or from within or beyond these parallaxes.
LEAST_COSINE = 0.7
LEAST_PARALLAX, LARGEST_PARALLAX = 0.015, 0.4
# Steps of inverse depth to either side, of a pixel in the most distant neighbour: a wide sweep, then those around it.
SWEEPS = (16, 6, 3)
# Side of the compared windows [px], and what is added to their variance: contrast of less says nothing. (Large windows
# make things wider: beside its edge, a thing's outline is seen in the window of what is behind it. Of the demo room's
# mesh, 88 percent of the vertices were true with windows of 3 and 83 with windows of 5. Where fewer than half of the
# neighbours are there, as in a short run, small ones are too noisy.)
WINDOW, WINDOW_OF_FEW = 3, 7
LEAST_VARIANCE = 1e-5
# Costs are 1 - ZNCC. Of a change by one step between neighbouring pixels, of a larger one where their grey is the same
# and falls off with this difference, and of the ends of the sweep beside its middle, where the map is. (The last only
# decides where nothing else does: with 0.05, whole regions stayed where the map has them.)
SMALL_JUMP, LARGE_JUMP, GREY_EDGE = 0.1, 0.8, 0.05
MAP_WEIGHT = 0.002
# Kept is a depth that as many neighbours find at the same place to this share of it.
AGREEING = 1
AGREEMENT = 0.02
# A view of which a smaller share agrees with its neighbours keeps all: of a short run, a poor mesh is better than none.
# (Of nine frames of 80x60 it was 16 to 26 percent, hardly more than by chance; of two rooms' frames 64 and more.)
LEAST_AGREED = 0.5

Image = NDArray[np.float32]


@dataclass(frozen=True)
class DepthView:
    """A camera at T_camera_world (4, 4), its grey image (H, W) in [0, 1], and z (H, W), 0 where unknown."""

    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]
    grey: Image
    depth: Image


def choose_neighbours(views: Sequence[DepthView], index: int) -> list[int]:
    """Which views one is compared with; fewer than NEIGHBOURS where there are no more."""
    view = views[index]
    median = float(np.median(view.depth[view.depth > 0])) if (view.depth > 0).any() else 1.0
    rated = []
    for other, candidate in enumerate(views):
        T = candidate.T_camera_world @ inverse_se3(view.T_camera_world)
        parallax = np.linalg.norm(T[:3, 3]) / median
        if other != index and T[2, 2] > LEAST_COSINE and LEAST_PARALLAX < parallax < LARGEST_PARALLAX:
            rated.append((float(np.log(parallax)), other))
    chosen: list[int] = []
    each = NEIGHBOURS // (2 * len(PARALLAXES))
    for wanted in np.log(PARALLAXES):
        order = [other for _, other in sorted(rated, key=lambda r: (abs(r[0] - wanted), r[1])) if other not in chosen]
        sides = [[other for other in order if (other < index) == before][:each] for before in (True, False)]
        taken = sides[0] + sides[1]
        chosen += taken + [other for other in order if other not in taken][: 2 * each - len(taken)]
    return chosen


def matched_depth(views: Sequence[DepthView], index: int, neighbours: Sequence[int]) -> Image:
    """Depth (H, W) of a view, corrected by its neighbours; its own where it has none."""
    view = views[index]
    known = view.depth > 0
    if not neighbours or not known.any():
        return view.depth
    inverse = 1.0 / np.where(known, view.depth, np.median(view.depth[known]))
    warps = [_warp(view, views[other]) for other in neighbours]
    # By such a step, what is seen from the most distant neighbour moves by a pixel or so.
    step = np.float32(1.0 / max(float(np.linalg.norm(b[:2])) for _, b in warps))
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # thousands of small pictures: waiting for other threads takes longer than the work
    try:
        inverse = _swept(view, [views[other] for other in neighbours], warps, inverse, step)
    finally:
        cv2.setNumThreads(threads)
    return np.where(inverse > 0, 1.0 / np.maximum(inverse, 1e-12), 0.0).astype(np.float32)


def agreed_depth(views: Sequence[DepthView], index: int, neighbours: Sequence[int]) -> Image:
    """Depth (H, W) of a view where AGREEING neighbours show the same place, 0 elsewhere.

    All of it where hardly any of the view is agreed on (LEAST_AGREED).
    """
    view = views[index]
    row, column = np.nonzero(view.depth > 0)
    points = view.camera.unproject(np.stack([column, row], axis=1) + 0.5, view.depth[row, column])
    agreeing = np.zeros(len(points), int)
    for other in (views[n] for n in neighbours):
        T = other.T_camera_world @ inverse_se3(view.T_camera_world)
        there = points @ T[:3, :3].T + T[:3, 3]
        front = there[:, 2] > 0
        pixels = other.camera.project(np.where(front[:, None], there, 1.0))
        inside = front & other.camera.contains(pixels)
        x, y = np.floor(pixels[inside]).astype(int).T
        seen = other.depth[y, x]
        agreeing[inside] += np.abs(there[inside, 2] - seen) < AGREEMENT * seen
    depth = np.zeros_like(view.depth)
    kept = agreeing >= AGREEING
    if kept.sum() < LEAST_AGREED * len(kept):
        return view.depth
    depth[row[kept], column[kept]] = view.depth[row[kept], column[kept]]
    return depth


def _warp(view: DepthView, other: DepthView) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A (3, 3) and b (3,): pixel (x, y) at inverse depth w is seen at A (x, y, 1) + w b, homogeneous, in `other`."""
    T = other.T_camera_world @ inverse_se3(view.T_camera_world)
    K = other.camera.matrix()
    A = K @ T[:3, :3] @ np.linalg.inv(view.camera.matrix())
    return A.astype(np.float32), (K @ T[:3, 3]).astype(np.float32)


def _swept(
    view: DepthView,
    others: Sequence[DepthView],
    warps: Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]],
    inverse: NDArray[np.floating],
    step: np.float32,
) -> Image:
    """Inverse depth (H, W) near `inverse` at which the others' pictures fit, found in steps."""
    for reach in SWEEPS:
        # Smooth, so that a window is carried over as one piece of a surface, but for edges.
        inverse = cv2.medianBlur(inverse.astype(np.float32), 3)
        inverse = cv2.bilateralFilter(inverse, -1, 0.03 * float(np.median(inverse)), 6)
        offsets = np.arange(-reach, reach + 1, dtype=np.float32)
        cost = _matching_cost(view, others, warps, inverse, step * offsets)
        cost += MAP_WEIGHT * np.abs(offsets) / reach
        inverse = inverse + step * (_least(_smoothed(cost, view.grey)) - reach)
    return inverse


def _matching_cost(
    view: DepthView,
    others: Sequence[DepthView],
    warps: Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]],
    inverse: Image,
    offsets: NDArray[np.float32],
) -> NDArray[np.float32]:
    """1 - ZNCC (H, W, D) at inverse depths inverse (H, W) + offsets (D,), as the mean of the views that see it.

    1 where none does.
    """
    height, width = view.grey.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32) + 0.5, np.arange(height, dtype=np.float32) + 0.5)
    window = WINDOW if len(others) >= NEIGHBOURS // 2 else WINDOW_OF_FEW
    mean, variance = _moments(view.grey, window)
    total, count = (np.zeros((len(offsets), height, width), np.float32) for _ in range(2))
    for other, (A, b) in zip(others, warps, strict=True):
        u, v, w = (A[r, 0] * x + A[r, 1] * y + A[r, 2] + b[r] * inverse for r in range(3))
        for d, offset in enumerate(offsets):
            over = 1.0 / np.maximum(w + b[2] * offset, 1e-3)
            columns, rows = (u + b[0] * offset) * over - 0.5, (v + b[1] * offset) * over - 0.5
            carried = cv2.remap(
                other.grey, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-99.0
            )
            there, spread = _moments(carried, window)
            together = cv2.blur(view.grey * carried, (window, window)) - mean * there
            seen = there >= 0.0  # no part of the window is outside
            score = together / np.sqrt((variance + LEAST_VARIANCE) * (spread + LEAST_VARIANCE))
            total[d] += np.where(seen, 1.0 - score, 0.0)
            count[d] += seen
    cost = np.where(count > 0, total / np.maximum(count, 1.0), 1.0)
    return np.ascontiguousarray(cost.transpose(1, 2, 0))


def _moments(grey: Image, window: int) -> tuple[Image, Image]:
    """Mean and variance (H, W) of the window around every pixel."""
    mean = cv2.blur(grey, (window, window))
    return mean, np.maximum(cv2.blur(grey * grey, (window, window)) - mean * mean, 0.0)


def _smoothed(cost: NDArray[np.float32], grey: Image) -> NDArray[np.float32]:
    """The costs (H, W, D) of the best ways to every pixel along its row and its column, from both sides, added up."""
    total = np.zeros_like(cost)
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        source, picture, target = (a.swapaxes(0, axis)[::step] for a in (cost, grey, total))
        before = source[0]
        target[0] += before
        for line in range(1, len(source)):
            least = before.min(axis=1, keepdims=True)
            edge = np.abs(picture[line] - picture[line - 1])[:, None]
            best = np.minimum(before, least + np.maximum(LARGE_JUMP * np.exp(-edge / GREY_EDGE), 1.5 * SMALL_JUMP))
            best[:, 1:] = np.minimum(best[:, 1:], before[:, :-1] + SMALL_JUMP)
            best[:, :-1] = np.minimum(best[:, :-1], before[:, 1:] + SMALL_JUMP)
            before = source[line] + best - least
            target[line] += before
    return total


def _least(cost: NDArray[np.float32]) -> Image:
    """Place (H, W) of the least of the costs (H, W, D), between steps by a parabola."""
    best = np.clip(cost.argmin(axis=2), 1, cost.shape[2] - 2)[..., None]
    left, middle, right = (np.take_along_axis(cost, best + k, axis=2)[..., 0] for k in (-1, 0, 1))
    curvature = np.maximum(left + right - 2.0 * middle, 1e-6)
    return best[..., 0] + np.clip((left - right) / (2.0 * curvature), -0.5, 0.5)
