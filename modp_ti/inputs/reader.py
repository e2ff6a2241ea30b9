"""Base classes of the readers in `modp_ti.inputs.readers`: the settings of a kind of tracker, and how it is read."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field, model_validator

from modp_ti.files.file_tree import FileTree
from pipelines.settings import StrictModel

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig, SourceSettings
    from modp_ti.inputs.protocol import Progress, Tracker
    from modp_ti.inputs.sources import ImageSource


class TrackerSettings(StrictModel):
    """Base class of readers: the `tracker` section of a scene, with what other sections depend on, and its reading.

    A kind whose poses belong to recordings of one layout reads the images of these too: it sets `source_kind`, and
    defines `recognises` and `open_images`.
    """

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
    source_kind: ClassVar[str] = ""
    """The `source.kind` of the recordings whose images this kind reads; empty if it reads none."""
    file_suffixes: ClassVar[Sequence[str]] = ()
    """Suffixes of the files that are such recordings, whatever they hold."""
    pose_files: ClassVar[Sequence[str]] = ()
    """Patterns of the files of poses in a folder of images that has no scene file, in the order of preference."""

    @abstractmethod
    def open(self, scene: SceneConfig, progress: Progress | None = None) -> Tracker:
        """Open the tracker of a scene whose `tracker` is this. See `modp_ti.open_tracker`."""

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        """Whether a folder or archive is a recording of `source_kind`. It must be cheap: it lists files at most."""
        return False

    @classmethod
    def open_images(cls, path: Path, source: SourceSettings) -> ImageSource:
        """Open the images of a recording of `source_kind`.

        Args:
            path: The file or folder.
            source: Settings of the images.

        Raises:
            InputError: If it is no such recording, or it is damaged.
        """
        raise NotImplementedError

    @classmethod
    def poses_of(cls, path: Path) -> tuple[dict[str, Any], Path] | None:
        """Return the settings that read the poses of a recording or of a folder of images, and their file.

        None if it has no poses of this kind.
        """
        file = next((file for pattern in cls.pose_files for file in path.glob(pattern)), None)
        return None if file is None else ({"path": str(file)}, file)


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


class TrajectorySettings(TimedPosesSettings, GivenPosesSettings):
    """Base class for trackers whose file is a trajectory in TUM's format."""

    places_panoramas: ClassVar[bool] = True
