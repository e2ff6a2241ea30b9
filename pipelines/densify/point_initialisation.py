"""Initial Gaussians from the tracked points of a whole sequence, as in 3DGS [Kerbl 2023, Section 5.1]."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import SH_C0, GaussianField
from fields.map.keyframe import Keyframe
from pipelines.optimise.exposure import scene_colours

NEIGHBOURS = 3
# FLANN's identifier of a single k-d tree, whose search is exact.
KDTREE_SINGLE = 4


@dataclass(frozen=True)
class PointCloud:
    """Coloured points.

    Attributes:
        xyz: Positions (N, 3) in the world frame.
        colour: Scene colours (N, 3) [1 = white].
    """

    xyz: NDArray[np.float64]
    colour: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.xyz)


def union_of_points(views: Iterable[Keyframe]) -> PointCloud:
    """Collect every tracked point once, ordered by id.

    Position and colour are taken from the last view that has the point on a valid pixel, since trackers refine their
    points over time.
    """
    ids, xyz, colour = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))], [np.zeros((0, 3))]
    for view in views:
        points = view.points
        inside = np.flatnonzero(view.camera.contains(points.pixels))
        places = np.floor(points.pixels[inside]).astype(int)
        valid = view.rgba[places[:, 1], places[:, 0], 3] > 0
        ids.append(points.ids[inside[valid]])
        xyz.append(points.xyz[inside[valid]])
        colour.append(scene_colours(view, places[valid]))
    every = np.concatenate(ids)
    _, first_from_the_end = np.unique(every[::-1], return_index=True)
    last = len(every) - 1 - first_from_the_end
    return PointCloud(np.concatenate(xyz)[last], np.concatenate(colour)[last])


def spacing(xyz: NDArray[np.float64], neighbours: int = NEIGHBOURS) -> NDArray[np.float64]:
    """Mean distance of each point to its nearest neighbours.

    Args:
        xyz: Points (N, 3).
        neighbours: Number of neighbours.

    Returns:
        Mean distances (N,).

    Raises:
        ValueError: If there are at most `neighbours` points.
    """
    if len(xyz) <= neighbours:
        raise ValueError(f"{len(xyz)} points have no {neighbours} neighbours each")
    # FLANN works in float32. Centring keeps its precision independent of the world's origin.
    centred = np.ascontiguousarray(xyz - np.median(xyz, axis=0), dtype=np.float32)
    tree = cv2.flann.Index(centred, {"algorithm": KDTREE_SINGLE})
    _, squares = tree.knnSearch(centred, neighbours + 1)
    # The first neighbour is the point itself.
    return np.sqrt(squares[:, 1:].astype(np.float64)).mean(axis=1)


def initialise(gaussians: GaussianField, points: PointCloud, opacity: float, smallest: float) -> None:
    """Add one isotropic Gaussian per point, with the mean distance to its neighbours as its standard deviation.

    If the pool is too small for all points, evenly spaced ones are used.

    Args:
        gaussians: Field to add to.
        points: The points.
        opacity: Initial opacity.
        smallest: Lower bound on the standard deviation [scene units], for coincident points.

    Raises:
        ValueError: If there are too few points for `spacing`.
    """
    n = min(len(points), gaussians.capacity - gaussians.count)
    chosen = np.arange(n) * len(points) // max(n, 1)
    xyz = points.xyz[chosen]
    size = np.maximum(spacing(xyz), smallest)
    sh = np.zeros((n, gaussians.sh_count, 3))
    sh[:, 0] = (points.colour[chosen] - 0.5) / SH_C0
    gaussians.append(
        position=xyz,
        log_scale=np.repeat(np.log(size)[:, None], 3, axis=1),
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        opacity_logit=np.full(n, np.log(opacity / (1.0 - opacity))),
        sh=sh,
    )
