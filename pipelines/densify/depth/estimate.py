"""The interface of depth estimators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fields.map.keyframe import Keyframe

__all__ = ["DepthEstimate", "DepthEstimator", "point_depths", "unknown_depth"]


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
