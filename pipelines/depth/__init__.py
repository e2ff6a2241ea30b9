"""Depth of pixels that no tracked point covers: one Protocol, several sources, and their fusion."""

from pipelines.depth.depthcov import DepthCov
from pipelines.depth.depthcov_checkpoint import load_depthcov
from pipelines.depth.estimate import DepthEstimate, DepthEstimator
from pipelines.depth.gaussian_process import GaussianProcessDepth

__all__ = ["DepthCov", "DepthEstimate", "DepthEstimator", "GaussianProcessDepth", "load_depthcov"]
