"""MODP-Ti: a photorealistic 3D Gaussian map from one RGB camera, built while the frames arrive.

    import modp_ti
    config = modp_ti.load_scene("scene.yaml")
    modp_ti.run_scene(config)

or, with frames of your own, `modp_ti.Mapper(width, height).add(modp_ti.TrackedFrame.from_arrays(...))`. The renderer
alone is `modp_ti.rasterize`, the voxels alone `modp_ti.OccupancyVoxels`; docs/api.md has examples of all.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

# For type checkers and editors alone: at run time `__getattr__` does it.
if TYPE_CHECKING:
    from fields.backend import initialise
    from fields.camera import PinholeCamera
    from fields.gaussians import GaussianField
    from fields.occupancy import OccupancyVoxels
    from fields.pose_correction import PoseCorrection
    from fields.se3 import torch_exp_se3
    from fields.tracked_frame import SparsePoints, TrackedFrame
    from modp_ti.config import load_scene
    from modp_ti.errors import InputError
    from modp_ti.exports.splats_ply import read_splats, write_splats
    from modp_ti.mapper import Mapper
    from modp_ti.session import run_scene
    from modp_ti.settings import SceneConfig
    from modp_ti.trackers import open_tracker
    from pipelines.mapping import OnlineMapper
    from pipelines.rasterization import RasterizedView, rasterize
    from pipelines.refinement import refine
    from pipelines.rendering import Renderer
    from pipelines.settings import MappingSettings, RefineSettings

__version__ = "0.2.0"

_HOMES = {
    "GaussianField": "fields.gaussians",
    "InputError": "modp_ti.errors",
    "Mapper": "modp_ti.mapper",
    "MappingSettings": "pipelines.settings",
    "OccupancyVoxels": "fields.occupancy",
    "OnlineMapper": "pipelines.mapping",
    "PinholeCamera": "fields.camera",
    "PoseCorrection": "fields.pose_correction",
    "RasterizedView": "pipelines.rasterization",
    "RefineSettings": "pipelines.settings",
    "Renderer": "pipelines.rendering",
    "SceneConfig": "modp_ti.settings",
    "SparsePoints": "fields.tracked_frame",
    "TrackedFrame": "fields.tracked_frame",
    "initialise": "fields.backend",
    "load_scene": "modp_ti.config",
    "open_tracker": "modp_ti.trackers",
    "rasterize": "pipelines.rasterization",
    "read_splats": "modp_ti.exports.splats_ply",
    "refine": "pipelines.refinement",
    "run_scene": "modp_ti.session",
    "torch_exp_se3": "fields.se3",
    "write_splats": "modp_ti.exports.splats_ply",
}
__all__ = [
    "GaussianField",
    "InputError",
    "Mapper",
    "MappingSettings",
    "OccupancyVoxels",
    "OnlineMapper",
    "PinholeCamera",
    "PoseCorrection",
    "RasterizedView",
    "RefineSettings",
    "Renderer",
    "SceneConfig",
    "SparsePoints",
    "TrackedFrame",
    "__version__",
    "initialise",
    "load_scene",
    "open_tracker",
    "rasterize",
    "read_splats",
    "refine",
    "run_scene",
    "torch_exp_se3",
    "write_splats",
]


# Hidden from type checkers, for whom it would make every name one of this module.
if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        # Loaded when first asked for: the command's help must not wait for compilers and readers.
        if name not in _HOMES:
            raise AttributeError(f"module 'modp_ti' has no attribute {name!r}")
        return getattr(importlib.import_module(_HOMES[name]), name)
