"""MODP-Ti: a photorealistic 3D Gaussian map from one RGB camera, built while the frames arrive.

    import modp_ti
    config = modp_ti.load_scene("scene.yaml")
    modp_ti.run_scene(config)

or, with frames of your own, `modp_ti.OnlineMapper(...).process(modp_ti.TrackedFrame(...))`.
"""

from __future__ import annotations

import importlib

__version__ = "0.1.0"

_HOMES = {
    "GaussianField": "fields.gaussians",
    "InputError": "modp_ti.errors",
    "MappingSettings": "pipelines.settings",
    "OnlineMapper": "pipelines.mapping",
    "PinholeCamera": "fields.camera",
    "RefineSettings": "pipelines.settings",
    "Renderer": "pipelines.rendering",
    "SceneConfig": "modp_ti.settings",
    "SparsePoints": "fields.tracked_frame",
    "TrackedFrame": "fields.tracked_frame",
    "initialise": "fields.backend",
    "load_scene": "modp_ti.config",
    "open_tracker": "modp_ti.trackers",
    "read_splats": "modp_ti.exports.splats_ply",
    "refine": "pipelines.refinement",
    "run_scene": "modp_ti.session",
    "write_splats": "modp_ti.exports.splats_ply",
}
__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> object:
    # Loaded when first asked for: the command's help must not wait for compilers and readers.
    if name not in _HOMES:
        raise AttributeError(f"module 'modp_ti' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
