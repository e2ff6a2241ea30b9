"""Joins the depths that the map, matching and planes suggest for the pixels of a view."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.surface.agreement import agreeing_views
from pipelines.surface.matched_depth import DepthView

# A pixel is plain if the grey values of its 3x3 neighbourhood differ by less than PLAIN. Regions with a smaller share
# of the view than LEAST_REGION are left alone.
PLAIN = 0.03
LEAST_REGION = 0.002
# Width of the border around a region whose depth counts as the region's [px].
BORDER = 5
# Hypotheses per region, and most points to try them on.
HYPOTHESES, MOST_POINTS = 64, 400
# A point lies on a plane if its inverse depth differs by at most this fraction. A plane needs this share of the points.
TOLERANCE = 0.01
LEAST_SHARE = 0.6
# The points on the plane must spread over at least this fraction of the region's extent, in both directions.
LEAST_SPREAD = 0.5


def fitted_plane(
    places: NDArray[np.float64], inverse: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.floating], NDArray[np.bool_]] | None:
    """Fit a plane to points of a view by RANSAC [Fischler and Bolles 1981]. The inverse depth of a plane is linear.

    Args:
        places: (N, 2) pixels.
        inverse: (N,) inverse depths.
        rng: Draws the hypotheses.

    Returns:
        (a, b, c) with inverse depth a x + b y + c, and (N,) which points lie on it; None if there is no such plane.
    """
    rows = np.column_stack([places, np.ones(len(places))])
    if len(rows) < 3:
        return None
    tried = np.arange(len(rows)) if len(rows) <= MOST_POINTS else rng.choice(len(rows), MOST_POINTS, replace=False)
    triples = tried[rng.integers(len(tried), size=(HYPOTHESES, 3))]
    corners = rows[triples]
    usable = np.abs(np.linalg.det(corners)) > 1.0  # twice the triangle's area [px^2]
    if not usable.any():
        return None
    planes = np.linalg.solve(corners[usable], inverse[triples[usable]][..., None])[..., 0]
    near = np.abs(planes @ rows[tried].T - inverse[tried]) < TOLERANCE * inverse[tried]
    plane = planes[near.sum(axis=1).argmax()]
    on_it = np.abs(rows @ plane - inverse) < TOLERANCE * inverse
    for _ in range(2):
        if on_it.sum() < max(LEAST_SHARE * len(rows), 3):
            return None
        plane = np.linalg.lstsq(rows[on_it], inverse[on_it], rcond=None)[0]
        on_it = np.abs(rows @ plane - inverse) < TOLERANCE * inverse
    return plane, on_it


def planes_of_plain_regions(
    grey: NDArray[np.float32], inverse: NDArray[np.float32], trusted: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return the inverse depth (H, W) of the planes that bound plain regions, 0 elsewhere.

    Args:
        grey: (H, W) image in [0, 1].
        inverse: (H, W) inverse depth.
        trusted: (H, W) whether the inverse depth is trusted.
    """
    rng = np.random.default_rng(0)
    window = np.ones((3, 3), np.uint8)
    plain = ((cv2.dilate(grey, window) - cv2.erode(grey, window)) < PLAIN).astype(np.uint8)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(plain, connectivity=4)
    found = np.zeros_like(inverse)
    border = np.ones((2 * BORDER + 1, 2 * BORDER + 1), np.uint8)
    for label in range(1, count):
        left, top, wide, high, area = boxes[label]
        if area < LEAST_REGION * grey.size:
            continue
        part = np.s_[max(top - BORDER, 0) : top + high + BORDER, max(left - BORDER, 0) : left + wide + BORDER]
        region = labels[part] == label
        around = cv2.dilate(region.astype(np.uint8), border) > 0
        row, column = np.nonzero(around & trusted[part])
        values = inverse[part][row, column].astype(np.float64)
        places = np.column_stack([column + part[1].start, row + part[0].start])
        fit = fitted_plane(places.astype(np.float64), values, rng)
        if fit is None:
            continue
        plane, on_it = fit
        spread = np.ptp(places[on_it], axis=0)
        if (spread < LEAST_SPREAD * np.array([wide, high])).any():
            continue
        row, column = np.nonzero(region)
        on_plane = plane[0] * (column + part[1].start) + plane[1] * (row + part[0].start) + plane[2]
        found[part][row, column] = np.maximum(on_plane, 0.0)
    return found


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
