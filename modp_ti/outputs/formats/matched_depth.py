"""Multi-view stereo that corrects the depth of rendered views.

A map is optimised for colour. In regions with little texture, Gaussians stay at their initial depth, which may be some
percent off, and all views agree on the wrong depth. The images still contain the parallax, and so do, less sharply,
pictures rendered from the map. Inverse depths around the map's are swept [Collins 1996]: each neighbour's image is
warped to the view and compared by ZNCC. Matching costs are aggregated along rows and columns [Hirschmueller 2008].
Where the images are ambiguous, the map's depth is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from pipelines.densify.depth.plane_sweep import plane_warp, sub_sample_peak

__all__ = ["DepthView", "agreed_depth", "choose_neighbours", "matched_depth"]

# Number of neighbours of a view, and the preferred parallaxes (baseline over median depth). Each parallax gets a third
# of the neighbours, if possible as many before the view as after it.
PARALLAXES = (0.25, 0.12, 0.06)
NEIGHBOURS = 12
# Limits for neighbours: cosine of the angle between the optical axes, and parallax.
LEAST_COSINE = 0.7
LEAST_PARALLAX, LARGEST_PARALLAX = 0.015, 0.4
# Number of sweep steps to either side, one pixel in the most distant neighbour each: a wide sweep, then two narrow
# ones.
SWEEPS = (16, 6, 3)
# Side of the matching windows [px], and a constant added to their variance, which suppresses weaker contrast. Large
# windows enlarge objects, because an object's outline falls into the windows of the background next to it: on the demo
# room's mesh, 88 percent of the vertices were correct with windows of 3, and 83 with windows of 5. With fewer than half
# of the neighbours, as in a short run, small windows are too noisy.
WINDOW, WINDOW_OF_FEW = 3, 7
LEAST_VARIANCE = 1e-5
# Costs are 1 - ZNCC. Penalties: a change by one step between adjacent pixels; a larger change, which decreases with
# their grey difference on the scale GREY_EDGE; and the distance from the map's depth, relative to the sweep's range.
# The last one only breaks ties: with 0.05, whole regions stayed at the map's depth.
SMALL_JUMP, LARGE_JUMP, GREY_EDGE = 0.1, 0.8, 0.05
MAP_WEIGHT = 0.002
# A depth is kept if this many neighbours find the same place within this relative tolerance.
AGREEING = 1
AGREEMENT = 0.02
# A view keeps all its depths if a smaller fraction agrees with its neighbours: for a short run, a poor mesh is better
# than none. The fraction was 16 to 26 percent for nine frames of 80x60, hardly more than chance, and 64 percent and
# more for the frames of two rooms.
LEAST_AGREED = 0.5

Image = NDArray[np.float32]


@dataclass(frozen=True)
class DepthView:
    """A view to be matched.

    Attributes:
        camera: The view's camera.
        T_camera_world: (4, 4) pose.
        grey: (H, W) grey image in [0, 1].
        depth: (H, W) z, 0 where unknown.
    """

    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]
    grey: Image
    depth: Image


def choose_neighbours(views: Sequence[DepthView], index: int) -> list[int]:
    """Return the indices of the views to match a view with, at most NEIGHBOURS."""
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
    """Return the depth (H, W) of a view, corrected by matching its neighbours.

    Without neighbours or known depth, the view's own depth is returned.
    """
    view = views[index]
    known = view.depth > 0
    if not neighbours or not known.any():
        return view.depth
    inverse = 1.0 / np.where(known, view.depth, np.median(view.depth[known]))
    others = [views[index] for index in neighbours]
    warps = [
        plane_warp(view.camera, view.T_camera_world, other.camera, other.T_camera_world).astype(np.float32)
        for other in others
    ]
    # One step of inverse depth moves a pixel by about one pixel in the most distant neighbour.
    step = np.float32(1.0 / max(float(np.linalg.norm(warp[:2, 3])) for warp in warps))
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # for thousands of small pictures, waiting for other threads takes longer than the work
    try:
        inverse = _swept(view, others, warps, inverse, step)
    finally:
        cv2.setNumThreads(threads)
    return np.where(inverse > 0, 1.0 / np.maximum(inverse, 1e-12), 0.0).astype(np.float32)


def agreed_depth(views: Sequence[DepthView], index: int, neighbours: Sequence[int]) -> Image:
    """Return the depth (H, W) of a view where AGREEING neighbours have the same surface, 0 elsewhere.

    If less than LEAST_AGREED of the view agrees, all of its depth is returned.
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


def _swept(
    view: DepthView,
    others: Sequence[DepthView],
    warps: Sequence[Image],
    inverse: NDArray[np.floating],
    step: np.float32,
) -> Image:
    """Sweep around `inverse` and return the inverse depth (H, W) with the least smoothed matching cost."""
    for reach in SWEEPS:
        # Smoothing except at edges, so that a window is warped as one piece of surface.
        smooth = cv2.medianBlur(inverse.astype(np.float32), 3)
        smooth = cv2.bilateralFilter(smooth, -1, 0.03 * float(np.median(smooth)), 6)
        inverse = np.asarray(smooth, dtype=np.float32)
        offsets = np.arange(-reach, reach + 1, dtype=np.float32)
        cost = _matching_cost(view, others, warps, inverse, step * offsets)
        cost += MAP_WEIGHT * np.abs(offsets) / reach
        inverse = inverse + step * (_least(_smoothed(cost, view.grey)) - reach)
    return inverse


def _matching_cost(
    view: DepthView,
    others: Sequence[DepthView],
    warps: Sequence[Image],
    inverse: Image,
    offsets: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return 1 - ZNCC (H, W, D) at inverse depths inverse (H, W) + offsets (D,), averaged over the views.

    Only views that see the pixel count. The cost is 1 if there are none.
    """
    height, width = view.grey.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32) + 0.5, np.arange(height, dtype=np.float32) + 0.5)
    window = WINDOW if len(others) >= NEIGHBOURS // 2 else WINDOW_OF_FEW
    mean, variance = _moments(view.grey, window)
    total, count = (np.zeros((len(offsets), height, width), np.float32) for _ in range(2))
    for other, warp in zip(others, warps, strict=True):
        u, v, w = (row[0] * x + row[1] * y + row[2] + row[3] * inverse for row in warp)
        for d, offset in enumerate(offsets):
            over = 1.0 / np.maximum(w + warp[2, 3] * offset, 1e-3)
            columns, rows = (u + warp[0, 3] * offset) * over - 0.5, (v + warp[1, 3] * offset) * over - 0.5
            carried = cv2.remap(
                other.grey, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-99.0
            )
            there, spread = _moments(np.asarray(carried, dtype=np.float32), window)
            together = cv2.blur(view.grey * carried, (window, window)) - mean * there
            seen = there >= 0.0  # the whole window is inside
            score = together / np.sqrt((variance + LEAST_VARIANCE) * (spread + LEAST_VARIANCE))
            total[d] += np.where(seen, 1.0 - score, 0.0)
            count[d] += seen
    cost = np.where(count > 0, total / np.maximum(count, 1.0), 1.0)
    return np.ascontiguousarray(cost.transpose(1, 2, 0))


def _moments(grey: Image, window: int) -> tuple[Image, Image]:
    """Return mean and variance (H, W) of the window around each pixel."""
    mean = np.asarray(cv2.blur(grey, (window, window)), dtype=np.float32)
    return mean, np.maximum(cv2.blur(grey * grey, (window, window)) - mean * mean, 0.0)


def _smoothed(cost: NDArray[np.float32], grey: Image) -> NDArray[np.float32]:
    """Sum the costs (H, W, D) of the best paths to each pixel along its row and column, from both sides."""
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
    """Return the index (H, W) of the least cost (H, W, D), with a parabola fit between steps."""
    best = np.clip(cost.argmin(axis=2), 1, cost.shape[2] - 2)[..., None]
    left, middle, right = (np.take_along_axis(cost, best + k, axis=2)[..., 0] for k in (-1, 0, 1))
    curvature = np.maximum(left + right - 2.0 * middle, 1e-6)
    return best[..., 0] + sub_sample_peak(right, left, curvature)
