"""Fusion of depth estimators by inverse variance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fields.map.keyframe import Keyframe
from pipelines.densify.depth.estimate import DepthEstimate, DepthEstimator, unknown_depth

__all__ = ["FusedDepth"]


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
