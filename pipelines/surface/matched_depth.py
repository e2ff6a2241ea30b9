"""Multi-view stereo that corrects the depth of rendered views.

A map is optimised for colour. In regions with little texture, Gaussians stay at their initial depth, which may be some
percent off, and all views agree on the wrong depth. The images still contain the parallax, and so do, less sharply,
pictures rendered from the map. Inverse depths around the map's are swept, first in images of half the size. Where the
images are ambiguous, the map's depth is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from pipelines.densify.depth.epipolar import plane_warp
from pipelines.surface.plane_sweep import PlaneSweep

# Number of neighbours of a view, and the preferred parallaxes (baseline over median depth). Each parallax gets a third
# of the neighbours, if possible as many before the view as after it.
PARALLAXES = (0.25, 0.12, 0.06)
NEIGHBOURS = 12
# Limits for neighbours: cosine of the angle between the optical axes, and parallax.
LEAST_COSINE = 0.7
LEAST_PARALLAX, LARGEST_PARALLAX = 0.015, 0.4
# Number of sweep steps to either side, one pixel in the most distant neighbour each: a wide sweep of the images at half
# the size, then two narrow ones.
COARSE, FINE = 8, (6, 3)
# Images with a shorter side than this are not halved [px].
LEAST_SIDE = 128

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


class DepthMatcher:
    """Matches views with their neighbours. The engine must have been started.

    Args:
        views: All views.

    Attributes:
        neighbours: Indices of the neighbours of each view.
    """

    def __init__(self, views: Sequence[DepthView]) -> None:
        self._views = views
        self._halves = [_half(view) for view in views]
        self.neighbours = [choose_neighbours(views, index) for index in range(len(views))]
        self._sweep = PlaneSweep(max(view.grey.size for view in views), 2 * max(COARSE, *FINE) + 1)

    def matched(self, index: int) -> Image:
        """Return the depth (H, W) of a view, corrected by matching its neighbours.

        Without neighbours or known depth, the view's own depth is returned.
        """
        view = self._views[index]
        known = view.depth > 0
        if not self.neighbours[index] or not known.any():
            return view.depth
        inverse = np.asarray(1.0 / np.where(known, view.depth, np.median(view.depth[known])), dtype=np.float32)
        for views, reaches in ((self._halves, (COARSE,)), (self._views, FINE)):
            for reach in reaches:
                inverse = self._swept(views, index, inverse, reach)
        return np.where(inverse > 0, 1.0 / np.maximum(inverse, 1e-12), 0.0).astype(np.float32)

    def _swept(self, views: Sequence[DepthView], index: int, inverse: Image, reach: int) -> Image:
        """Sweep `reach` steps around an inverse depth, and return the better one in the size of `views`."""
        view, others = views[index], [views[other] for other in self.neighbours[index]]
        warps = [
            plane_warp(view.camera, view.T_camera_world, other.camera, other.T_camera_world).astype(np.float32)
            for other in others
        ]
        size = view.grey.shape[::-1]
        if size[0] < inverse.shape[1]:
            inverse = np.asarray(cv2.resize(inverse, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        smooth = _smoothed(inverse)
        if size[0] > smooth.shape[1]:
            smooth = cv2.resize(smooth, size, interpolation=cv2.INTER_LINEAR)
        # One step moves a pixel by about one pixel in the most distant neighbour.
        step = 1.0 / max(float(np.linalg.norm(warp[:2, 3])) for warp in warps)
        start = np.ascontiguousarray(smooth, dtype=np.float32)
        return self._sweep.sweep(view.grey, [other.grey for other in others], warps, start, step, reach)


def _smoothed(inverse: Image) -> Image:
    """Smooth an inverse depth (H, W) except at edges, so that a window is warped as one piece of surface.

    The four sets of every second pixel of every second row are smoothed one by one, which takes a quarter of the time.
    """
    median = cv2.medianBlur(inverse, 3)
    edge = 0.03 * float(np.median(median))
    smooth = np.empty_like(inverse)
    for r, c in np.ndindex(2, 2):
        smooth[r::2, c::2] = cv2.bilateralFilter(np.ascontiguousarray(median[r::2, c::2]), -1, edge, 3)
    return smooth


def _half(view: DepthView) -> DepthView:
    """Return the view at half its size, unless it is small already. The depth stays as it is."""
    if min(view.grey.shape) < LEAST_SIDE:
        return view
    camera = view.camera.resized(view.camera.width // 2, view.camera.height // 2)
    grey = cv2.resize(view.grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return replace(view, camera=camera, grey=grey)
