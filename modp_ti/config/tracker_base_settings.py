"""The settings that several kinds of trackers share."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field, model_validator

from pipelines.settings import StrictModel

__all__ = ["GivenPosesSettings", "RecordedSettings", "TimedPosesSettings", "TrackerSettings"]


class TrackerSettings(StrictModel):
    """Base class of all tracker settings, with the properties of a kind that other sections depend on."""

    # Each kind narrows it to one literal. Declared here so that it is the first key in `config.yaml` and in the docs.
    kind: Any

    needs_source: ClassVar[bool] = True
    """Whether the images come from `source`; other trackers provide their own."""
    brings_cameras: ClassVar[bool] = False
    """Whether the tracker provides the camera of every image, so that `source.intrinsics` must be empty."""
    follows_streams: ClassVar[bool] = False
    """Whether the tracker works on a live `source.stream`, whose images are not known in advance."""
    is_live: ClassVar[bool] = False
    """Whether the frames arrive from another program and cannot be read again after the run."""
    places_panoramas: ClassVar[bool] = False
    """Whether the tracker has poses of images that see all round, which `source.panorama` cuts into faces."""


class RecordedSettings(TrackerSettings):
    """Base class for trackers that read the results of earlier tracking from files."""

    # Each kind describes its file and the default places in its own `description`.
    path: Path | None = None


class TimedPosesSettings(RecordedSettings):
    """Base class for trackers that match poses with images by time stamp."""

    max_difference: float = Field(
        default=0.02, gt=0, description="largest difference [s] between the times of an image and its pose"
    )
    time_offset: float = Field(
        default=0.0, description="offset [s] added to the times of the poses, if their clock differs from the images'"
    )


class GivenPosesSettings(RecordedSettings):
    """Base class for trackers whose file contains poses but no points."""

    adjusts_by_default: ClassVar[bool] = False

    points: Path | None = Field(
        default=None,
        description="world points: PLY, or text with `x y z` per line; empty: features are tracked and triangulated "
        "with the poses",
    )
    adjust: bool | None = Field(
        default=None,
        description="without `points`: bundle adjust the poses with the triangulated points before the first frame. "
        "Use it for poses of another sensor or with errors of more than a pixel. Empty: false",
    )
    max_points: int = Field(
        default=2000, ge=10, description="largest number of points of a frame that are taken from `points`"
    )

    @property
    def adjusts(self) -> bool:
        """Whether the poses are adjusted before the first frame."""
        return self.adjusts_by_default if self.adjust is None else self.adjust

    @model_validator(mode="after")
    def _only_triangulated_points_can_adjust(self) -> GivenPosesSettings:
        if self.adjust and self.points is not None:
            raise ValueError("tracker.adjust cannot be used with tracker.points; remove one of them")
        return self
