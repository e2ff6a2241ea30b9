"""The interface of depth estimators, their fusion, and the cost of a wrong depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from fields.map.keyframe import Keyframe


@dataclass(frozen=True)
class DepthEstimate:
    """Estimated depth of N pixels.

    Attributes:
        depth: Depth (N,) [scene units].
        deviation: Standard deviation (N,) of log depth; inf where the depth is unknown.
    """

    depth: NDArray[np.float64]
    deviation: NDArray[np.float64]

    def __getitem__(self, keep: slice) -> DepthEstimate:
        return DepthEstimate(self.depth[keep], self.deviation[keep])


class DepthEstimator(Protocol):
    """Protocol of a depth estimator for high-error pixels (Section 3.2.2)."""

    def estimate(self, view: Keyframe, neighbours: Sequence[Keyframe], pixels: NDArray[np.float64]) -> DepthEstimate:
        """Estimate the depth of pixels.

        Args:
            view: View of the pixels.
            neighbours: Other keyframes with poses, which may show the same places.
            pixels: Pixels (N, 2) of `view` as (x, y).

        Returns:
            Depth and deviation of each pixel.
        """
        ...


def unknown_depth(count: int) -> DepthEstimate:
    """Estimate in which the depth of all `count` pixels is unknown."""
    return DepthEstimate(np.ones(count), np.full(count, np.inf))


def point_depths(view: Keyframe) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (N, 2) and depths (N,) of the tracked points in front of the camera and inside the image."""
    z = view.points.depths(view.T_camera_world)
    usable = (z > 0) & view.camera.contains(view.points.pixels)
    return view.points.pixels[usable], z[usable]


class FusedDepth:
    """Mean of log depth over several estimators, weighted by inverse variance.

    If the estimators contradict one another by more than their deviations allow, the Birge ratio [Birge 1932] increases
    the fused deviation, so that the pixel stays uncertain.

    Args:
        estimators: Estimators to fuse.
    """

    def __init__(self, estimators: Sequence[DepthEstimator]) -> None:
        self.estimators = list(estimators)

    def estimate(self, view: Keyframe, neighbours: Sequence[Keyframe], pixels: NDArray[np.float64]) -> DepthEstimate:
        """See `DepthEstimator`."""
        estimates = [e.estimate(view, neighbours, pixels) for e in self.estimators]
        if not estimates:
            return unknown_depth(len(pixels))
        log_depth = np.log([e.depth for e in estimates])
        # The floor on the deviation keeps one source from overruling all others.
        weight = 1.0 / np.square(np.maximum([e.deviation for e in estimates], 1e-4))
        total = weight.sum(axis=0)
        known = total > 0
        total = np.where(known, total, 1.0)
        mean = (weight * log_depth).sum(axis=0) / total
        freedom = np.maximum((weight > 0).sum(axis=0) - 1, 1)
        birge = (weight * (log_depth - mean) ** 2).sum(axis=0) / freedom
        deviation = np.sqrt(np.maximum(birge, 1.0) / total)
        return DepthEstimate(np.exp(mean), np.where(known, deviation, np.inf))


MAX_VIEWS = 16
# Points nearer to a camera than this are not seen by it [its median depths].
NEAR = 0.01


def misplacement(
    view: Keyframe,
    neighbours: Sequence[Keyframe],
    pixels: NDArray[np.float64],
    depth: NDArray[np.float64],
    deviation: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Distance by which a depth that is wrong by its deviation moves a pixel's point in other views.

    Args:
        view: The view of the pixels.
        neighbours: The other views, of which at most `MAX_VIEWS` are used, spread evenly over the list.
        pixels: Pixels (N, 2) as (x, y).
        depth: Depth (N,) of the pixels.
        deviation: Standard deviation (N,) of log depth.

    Returns:
        Root mean square (N,) over the views that see the point [px]; inf where none does.
    """
    T_world_camera = inverse_se3(view.T_camera_world)
    square, count = np.zeros(len(depth)), np.zeros(len(depth))
    places = [
        view.camera.unproject(pixels, z) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        for z in (depth, depth * np.exp(deviation))
    ]
    some = np.unique(np.linspace(0, len(neighbours) - 1, min(MAX_VIEWS, len(neighbours))).round().astype(int))
    for other in (neighbours[j] for j in some):
        a, b = (xyz @ other.T_camera_world[:3, :3].T + other.T_camera_world[:3, 3] for xyz in places)
        nearest = NEAR * other.median_depth
        front = np.flatnonzero((a[:, 2] > nearest) & (b[:, 2] > nearest))
        a, b = other.camera.project(a[front]), other.camera.project(b[front])
        seen = other.camera.contains(a)
        square[front[seen]] += ((a - b)[seen] ** 2).sum(axis=1)
        count[front[seen]] += 1
    return np.where(count > 0, np.sqrt(square / np.maximum(count, 1)), np.inf)
