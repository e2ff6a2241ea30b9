"""The interface of depth estimators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fields.map.keyframe import Keyframe

__all__ = ["DepthEstimate", "DepthEstimator", "FusedDepth", "point_depths", "unknown_depth"]


@dataclass(frozen=True)
class DepthEstimate:
    """Estimated depth of N pixels.

    Attributes:
        depth: Depth (N,) [scene units].
        deviation: Standard deviation (N,) of log depth; inf where the depth is unknown.
    """

    depth: NDArray[np.float64]
    deviation: NDArray[np.float64]


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
