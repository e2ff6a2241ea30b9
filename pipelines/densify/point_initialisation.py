"""Gaussians from the tracked points of a whole sequence, as 3DGS starts [Kerbl 2023, Section 5.1]."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import SH_C0, GaussianField
from fields.map.keyframes import Keyframe
from pipelines.optimise.exposure import scene_colours

__all__ = ["PointCloud", "initialise", "spacing", "union_of_points"]

NEIGHBOURS = 3
# FLANN's name for one k-d tree, whose answers are exact.
KDTREE_SINGLE = 4


@dataclass(frozen=True)
class PointCloud:
    """Points of the world: xyz (N, 3), colour (N, 3) in [0, 1]."""

    xyz: NDArray[np.float64]
    colour: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.xyz)


def union_of_points(views: Iterable[Keyframe]) -> PointCloud:
    """Every tracked point once, in the order of their ids.

    Position and colour are those of the last view that has the point on a valid pixel: trackers that refine
    their points know them best at the end.
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
    """Mean distance (N,) of every point (N, 3) to its nearest neighbours. Raises ValueError for too few points."""
    if len(xyz) <= neighbours:
        raise ValueError(f"{len(xyz)} points have no {neighbours} neighbours each")
    # float32 inside FLANN: centred, so that digits go to the distances and not to where the world's origin is.
    centred = np.ascontiguousarray(xyz - np.median(xyz, axis=0), dtype=np.float32)
    tree = cv2.flann_Index(centred, {"algorithm": KDTREE_SINGLE})
    _, squares = tree.knnSearch(centred, neighbours + 1)
    # The nearest of all is the point itself.
    return np.sqrt(squares[:, 1:].astype(np.float64)).mean(axis=1)


def initialise(gaussians: GaussianField, points: PointCloud, opacity: float, smallest: float) -> None:
    """Add an isotropic Gaussian a point, as wide as its neighbours are far; an even choice where the pool is smaller.

    smallest: least size [scene units], for points that coincide. Raises ValueError for too few points.
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
