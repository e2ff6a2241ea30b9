"""Joins the depths that the map, matching and planes suggest for the pixels of a view."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pipelines.surface.agreement import agreeing_views
from pipelines.surface.matched_depth import DepthView
from pipelines.surface.planes import planes_of_plain_regions

__all__ = ["joined_depth"]

# Depths agree within this relative tolerance.
AGREEMENT = 0.02
# Number of agreeing views that make a matched depth one to fit planes to, and one to keep.
TRUSTED, KEPT = 3, 1
# A view keeps all its depths if a smaller fraction agrees with its neighbours: for a short run, a poor mesh is better
# than none. The fraction was 16 to 26 percent for nine frames of 80x60, hardly more than chance, and 64 percent and
# more for the frames of two rooms.
LEAST_AGREED = 0.5

Image = NDArray[np.float32]


def joined_depth(
    views: Sequence[DepthView], matched: Sequence[Image], neighbours: Sequence[Sequence[int]], order: Iterable[int]
) -> Iterator[Image]:
    """Yield the depth (H, W) of each view, 0 where unknown.

    Each pixel takes the depth that most of the neighbours agree with: the matched one, that of the plane around its
    plain region, or the map's own.

    Args:
        views: The views, with the map's depth.
        matched: (H, W) matched depth of each view.
        neighbours: Indices of each view's neighbours.
        order: Indices of the views.
    """
    for index in order:
        view = views[index]
        others = [(views[n].camera, views[n].T_camera_world, matched[n]) for n in neighbours[index]]

        def agreeing(depth: Image, view: DepthView = view, others: list = others) -> Image:
            return agreeing_views((view.camera, view.T_camera_world, depth), others, AGREEMENT)

        depth = matched[index]
        count = agreeing(depth)
        if (count >= KEPT).sum() < LEAST_AGREED * (depth > 0).sum():
            yield depth
            continue
        inverse = np.where(depth > 0, 1.0 / np.maximum(depth, 1e-12), 0.0).astype(np.float32)
        plane = planes_of_plain_regions(view.grey, inverse, count >= TRUSTED)
        for other in (np.where(plane > 0, 1.0 / np.maximum(plane, 1e-12), 0.0).astype(np.float32), view.depth):
            of_other = agreeing(other)
            better = of_other > count
            depth, count = np.where(better, other, depth), np.where(better, of_other, count)
        yield np.where(count >= KEPT, depth, 0.0).astype(np.float32)
