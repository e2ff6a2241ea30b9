"""MODP-Ti: a photorealistic 3D Gaussian map from one RGB camera, built while the frames arrive.

    import modp_ti
    config = modp_ti.load_scene("scene.yaml")
    modp_ti.run_scene(config)

or, with frames of your own, `modp_ti.Mapper(width, height).add(modp_ti.TrackedFrame.from_arrays(...))`. The renderer
alone is `modp_ti.rasterize`, the voxels alone `modp_ti.OccupancyVoxels`; docs/api.md has examples of all.
"""

from __future__ import annotations

import importlib

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
__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> object:
    # Loaded when first asked for: the command's help must not wait for compilers and readers.
    if name not in _HOMES:
        raise AttributeError(f"module 'modp_ti' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
