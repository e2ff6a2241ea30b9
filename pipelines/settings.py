"""Settings of everything that happens to the map: one section a concept, each field with its default and meaning.

The sections are part of the one configuration model (`modp_ti.config.SceneConfig`); lengths are relative to the
scene: `view scale` is the median of depth / focal length over a view's sparse points (Section 3.2.1), `scene depth`
the median depth of the sparse points.
"""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

__all__ = [
    "DensifySettings",
    "KeyframeSettings",
    "MappingSettings",
    "OptimiseSettings",
    "PoseSettings",
    "RefineSettings",
    "StrictModel",
    "ViewSettings",
    "VoxelSettings",
]


class StrictModel(BaseModel):
    """Immutable section of the configuration; an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


class KeyframeSettings(StrictModel):
    """When a frame becomes a keyframe (Section 3.3.1)."""

    covisibility: float = Field(0.95, ge=0, le=1, description="a frame that shares less than this with the last keyframe becomes one")
    max_gap: int = Field(5, ge=1, description="frames after which a keyframe is taken in any case (t_k)")
    max_rotation: float = Field(10.0, gt=0, description="degrees per frame above which a frame is too blurred to be a keyframe")
    min_points: int = Field(10, ge=0, description="tracked points that a keyframe needs")


class MappingSettings(StrictModel):
    """The parts of the online loop."""

    sh_degree: int = Field(0, ge=0, le=3, description="degree of the spherical harmonics")
    keyframes: KeyframeSettings = KeyframeSettings()
