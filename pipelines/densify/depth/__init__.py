"""Depth estimation at pixels without a tracked point: a protocol, several sources, and their fusion."""

from pipelines.densify.depth.depthcov import DepthCov, load_depthcov
from pipelines.densify.depth.epipolar import EpipolarDepth
from pipelines.densify.depth.estimate import DepthEstimate, DepthEstimator, FusedDepth
from pipelines.densify.depth.gaussian_process import GaussianProcessDepth, ImageGuidedDepth
from pipelines.densify.depth.map_depth import MapDepth
from pipelines.densify.depth.sources import build_depth

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
