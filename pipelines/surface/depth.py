"""The depth of a map's views, corrected by multi-view stereo and by planes.

A map is optimised for colour. In regions with little texture, Gaussians stay at their initial depth, which may be some
percent off, and all views agree on the wrong depth. The images still contain the parallax, and so do, less sharply,
pictures rendered from the map. Inverse depths around the map's are swept, first in images of half the size. Where the
images are ambiguous, the map's depth is kept.
"""
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from fields.runtime.engine import ti
from pipelines.densify.depth.epipolar import plane_warp
from pipelines.surface.plane_sweep import LANES, PlaneSweep

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


IMAGE = ti.types.ndarray(dtype=ti.f32, ndim=2)
Placed = tuple[PinholeCamera, NDArray[np.float64], NDArray[np.float32]]


def agreeing_views(view: Placed, others: Iterable[Placed], tolerance: float) -> NDArray[np.float32]:
    """Return how many other views have the same depth at each pixel (H, W).

    Args:
        view: Camera, T_camera_world (4, 4) and depth (H, W), 0 where unknown.
        others: The same for each of the other views.
        tolerance: Largest relative difference of depths that are the same.
    """
    camera, T, depth = view
    count = np.zeros_like(depth)
    for other, T_other, there in others:
        _count_agreeing(depth, plane_warp(camera, T, other, T_other).astype(np.float32), there, tolerance, count)
    return count


@ti.kernel
def _count_agreeing(depth: IMAGE, warp: IMAGE, other: IMAGE, tolerance: ti.f32, count: IMAGE):
    width = depth.shape[1]
    groups = (width + LANES - 1) // LANES
    for i in range(depth.shape[0] * groups):
        row, first = i // groups, i % groups * LANES
        v, lanes = row + 0.5, ti.min(LANES, width - first)
        agreed = ti.Vector([0.0] * LANES)
        for k in range(lanes):
            u, z = first + k + 0.5, depth[row, first + k]
            p = ti.Vector([0.0, 0.0, 0.0])
            for r in ti.static(range(3)):
                p[r] = z * (warp[r, 0] * u + warp[r, 1] * v + warp[r, 2]) + warp[r, 3]
            over = 1.0 / ti.max(p[2], 1e-12)
            x, y = p[0] * over, p[1] * over
            inside = (z > 0.0) & (p[2] > 0.0) & (x >= 0.0) & (y >= 0.0) & (x < other.shape[1]) & (y < other.shape[0])
            there = other[ti.cast(ti.select(inside, y, 0.0), ti.i32), ti.cast(ti.select(inside, x, 0.0), ti.i32)]
            agreed[k] = ti.select(inside & (ti.abs(p[2] - there) < tolerance * there), 1.0, 0.0)
        for k in range(lanes):
            count[row, first + k] = count[row, first + k] + agreed[k]


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
