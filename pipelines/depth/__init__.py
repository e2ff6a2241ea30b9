"""Depth of pixels that no tracked point covers: one Protocol, several sources, and their fusion."""

from pipelines.depth.depthcov import DepthCov
from pipelines.depth.depthcov_checkpoint import load_depthcov
from pipelines.depth.epipolar import EpipolarDepth
from pipelines.depth.estimate import DepthEstimate, DepthEstimator
from pipelines.depth.fusion import FusedDepth
from pipelines.depth.gaussian_process import GaussianProcessDepth, ImageGuidedDepth
from pipelines.depth.map_depth import MapDepth
from pipelines.depth.sources import build_depth

__all__ = [
    "DepthCov",
    "DepthEstimate",
    "DepthEstimator",
    "EpipolarDepth",
    "FusedDepth",
    "GaussianProcessDepth",
    "ImageGuidedDepth",
    "MapDepth",
    "build_depth",
    "load_depthcov",
]
