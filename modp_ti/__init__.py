"""MODP-Ti: online monocular 3D Gaussian mapping in Taichi.

Map the scene that a `scene.yaml` describes:

    import modp_ti

    config = modp_ti.load_scene("scene.yaml", overrides=["source.scale=0.5"])
    modp_ti.run_scene(config)

Map frames from your own loop:

    modp_ti.initialise("cpu")
    with modp_ti.Mapper(width=640, height=480) as mapper:
        mapper.add(modp_ti.TrackedFrame.from_arrays(index, image, T_camera_world, intrinsics, xyz, pixels))
        mapper.save("out/room")

Find out where a new picture was taken in a finished map:

    location = modp_ti.Locator("out/room").locate("new.jpg")

Use one part alone:

    picture = modp_ti.rasterize(**gaussians, T_camera_world=T_camera_world, camera=camera)  # a PyTorch function
    kept = points[modp_ti.OccupancyVoxels(coarsest=1.0, levels=8).admit(points, 0.25)]  # multi-resolution occupancy

`docs/api.md` has complete examples. Names are imported on first access, so `import modp_ti` does not load Taichi.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from modp_ti.files.own_zlib import keep_apart
from modp_ti.version import __version__ as __version__

keep_apart()  # before anything loads pycolmap

# Only for type checkers and editors. At run time `__getattr__` imports these names on first access.
if TYPE_CHECKING:
    from fields.frames.pose_correction import PoseCorrection as PoseCorrection
    from fields.frames.tracked_frame import SparsePoints as SparsePoints
    from fields.frames.tracked_frame import TrackedFrame as TrackedFrame
    from fields.geometry.camera import PinholeCamera as PinholeCamera
    from fields.geometry.se3 import torch_exp_se3 as torch_exp_se3
    from fields.map.gaussians import GaussianField as GaussianField
    from fields.runtime.backend import initialise as initialise
    from fields.voxels.occupancy import OccupancyVoxels as OccupancyVoxels
    from modp_ti.config.scene_file import load_scene as load_scene
    from modp_ti.config.settings import SceneConfig as SceneConfig
    from modp_ti.engine.mapper import Mapper as Mapper
    from modp_ti.engine.session import run_scene as run_scene
    from modp_ti.files.errors import InputError as InputError
    from modp_ti.inputs.opening import open_tracker as open_tracker
    from modp_ti.outputs.formats.splats_ply import read_splats as read_splats
    from modp_ti.outputs.formats.splats_ply import write_splats as write_splats
    from modp_ti.outputs.locating.locator import Location as Location
    from modp_ti.outputs.locating.locator import Locator as Locator
    from pipelines.online import OnlineMapper as OnlineMapper
    from pipelines.refinement import refine as refine
    from pipelines.render.rasterize import RasterizedView as RasterizedView
    from pipelines.render.rasterize import rasterize as rasterize
    from pipelines.render.renderer import Renderer as Renderer
    from pipelines.settings import MappingSettings as MappingSettings
    from pipelines.settings import RefineSettings as RefineSettings

_HOMES = {
    "GaussianField": "fields.map.gaussians",
    "InputError": "modp_ti.files.errors",
    "Location": "modp_ti.outputs.locating.locator",
    "Locator": "modp_ti.outputs.locating.locator",
    "Mapper": "modp_ti.engine.mapper",
    "MappingSettings": "pipelines.settings",
    "OccupancyVoxels": "fields.voxels.occupancy",
    "OnlineMapper": "pipelines.online",
    "PinholeCamera": "fields.geometry.camera",
    "PoseCorrection": "fields.frames.pose_correction",
    "RasterizedView": "pipelines.render.rasterize",
    "RefineSettings": "pipelines.settings",
    "Renderer": "pipelines.render.renderer",
    "SceneConfig": "modp_ti.config.settings",
    "SparsePoints": "fields.frames.tracked_frame",
    "TrackedFrame": "fields.frames.tracked_frame",
    "initialise": "fields.runtime.backend",
    "load_scene": "modp_ti.config.scene_file",
    "open_tracker": "modp_ti.inputs.opening",
    "rasterize": "pipelines.render.rasterize",
    "read_splats": "modp_ti.outputs.formats.splats_ply",
    "refine": "pipelines.refinement",
    "run_scene": "modp_ti.engine.session",
    "torch_exp_se3": "fields.geometry.se3",
    "write_splats": "modp_ti.outputs.formats.splats_ply",
}

# Hidden from type checkers, which would otherwise accept any attribute name of this module.
if not TYPE_CHECKING:
    __all__ = ["__version__", *_HOMES]

    def __getattr__(name: str) -> object:
        # Lazy, so that `modp-ti --help` does not wait for Taichi and the file readers to load.
        if name not in _HOMES:
            raise AttributeError(f"module 'modp_ti' has no attribute {name!r}")
        return getattr(importlib.import_module(_HOMES[name]), name)
