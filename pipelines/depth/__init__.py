"""Depth of pixels that no tracked point covers: one Protocol, several sources, and their fusion."""

from pipelines.depth.estimate import DepthEstimate, DepthEstimator
from pipelines.depth.gaussian_process import GaussianProcessDepth

__all__ = ["DepthEstimate", "DepthEstimator", "GaussianProcessDepth"]
