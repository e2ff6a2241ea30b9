"""What every depth estimator takes and gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fields.map.keyframes import Keyframe

__all__ = ["DepthEstimate", "DepthEstimator", "point_depths", "unknown_depth"]


@dataclass(frozen=True)
class DepthEstimate:
    """depth (N,) [scene units] and the standard deviation of its logarithm (N,), of N pixels; inf where unknown."""

    depth: NDArray[np.float64]
    deviation: NDArray[np.float64]


class DepthEstimator(Protocol):
    """Estimates depth where it is asked for (Section 3.2.2, high error regions)."""

    def estimate(self, view: Keyframe, neighbours: Sequence[Keyframe], pixels: NDArray[np.float64]) -> DepthEstimate:
        """Depth of the pixels (N, 2) as (x, y) of `view`, which may be seen in the posed `neighbours` too."""


def unknown_depth(count: int) -> DepthEstimate:
    """An estimate of `count` pixels that knows nothing."""
    return DepthEstimate(np.ones(count), np.full(count, np.inf))


def point_depths(view: Keyframe) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (N, 2) and depths (N,) of the tracked points that lie before the camera and in the image."""
    z = view.points.depths(view.T_camera_world)
    usable = (z > 0) & view.camera.contains(view.points.pixels)
    return view.points.pixels[usable], z[usable]
