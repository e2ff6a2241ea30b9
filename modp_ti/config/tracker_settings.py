"""The `tracker` section of a scene: one model per `tracker.kind`, with only the keys of that kind.

To add a kind, write its model here, add it to `AnyTrackerSettings`, and register its opener in
`modp_ti.inputs.trackers.openers`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from pipelines.settings import StrictModel

__all__ = [
    "AnyTrackerSettings",
    "AriaSettings",
    "ColmapSettings",
    "GivenPosesSettings",
    "KltSettings",
    "ModpSettings",
    "OrbSlam3Settings",
    "RecordedSettings",
    "ReplicaSettings",
    "SevenScenesSettings",
    "SocketSettings",
    "StellaVslamSettings",
    "TimedPosesSettings",
    "TrackerSettings",
    "TransformsSettings",
    "TumSettings",
]


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


class RecordedSettings(TrackerSettings):
    """Base class for trackers that read the results of earlier tracking from files."""

    # Each kind describes its file and the default places in its own `description`.
    path: Path | None = None


class TimedPosesSettings(RecordedSettings):
    """Base class for trackers that match poses with images by time stamp."""

    max_difference: float = Field(
        default=0.02, gt=0, description="seconds by which a pose's time may differ from its image's time"
    )
    time_offset: float = Field(
        default=0.0, description="seconds added to the times of the poses, where their clock is not that of the images"
    )


class GivenPosesSettings(RecordedSettings):
    """Base class for trackers whose file contains poses but no points."""

    adjusts_by_default: ClassVar[bool] = False

    points: Path | None = Field(
        default=None,
        description="world points: PLY, or text with `x y z` a line; empty to have features tracked and triangulated "
        "with the poses",
    )
    adjust: bool | None = Field(
        default=None,
        description="without `points`: bundle adjust the poses with the triangulated points before the first frame, "
        "for poses that are those of another sensor or not exact to a pixel; empty for false",
    )
    max_points: int = Field(default=2000, ge=10, description="points of the point file that one frame is shown at most")

    @property
    def adjusts(self) -> bool:
        """Whether the poses are adjusted before the first frame."""
        return self.adjusts_by_default if self.adjust is None else self.adjust

    @model_validator(mode="after")
    def _only_triangulated_points_can_adjust(self) -> GivenPosesSettings:
        if self.adjust and self.points is not None:
            raise ValueError("tracker.adjust is for poses without tracker.points; take one of them out")
        return self


class ColmapSettings(RecordedSettings):
    """A COLMAP model, binary or text."""

    brings_cameras: ClassVar[bool] = True

    kind: Literal["colmap"] = Field(default="colmap", description="a COLMAP model")
    path: Path | None = Field(
        default=None,
        description="folder with cameras, images and points3D, or the one above its folder `0`; empty: `sparse/0` or "
        "`sparse`, beside the images' folder or in it",
    )


class TransformsSettings(RecordedSettings):
    """A transforms.json of instant-ngp or nerfstudio."""

    brings_cameras: ClassVar[bool] = True

    kind: Literal["transforms"] = Field(
        default="transforms", description="a transforms.json of instant-ngp or nerfstudio"
    )
    path: Path | None = Field(
        default=None,
        description="the file, or its folder; empty: `transforms.json` beside the images' folder or in it",
    )


class KltSettings(TrackerSettings):
    """The built-in tracker, which needs only the images."""

    follows_streams: ClassVar[bool] = True

    kind: Literal["klt"] = Field(default="klt", description="the images alone: our own tracker")


class TumSettings(TimedPosesSettings, GivenPosesSettings):
    """A trajectory in TUM's format."""

    kind: Literal["tum"] = Field(default="tum", description="any trajectory in TUM's format")
    path: Path | None = Field(
        default=None,
        description="the file, or its folder; empty: `groundtruth.txt`, `trajectory.txt`, `CameraTrajectory.txt` or "
        "`KeyFrameTrajectory.txt`, in the images' folder or beside it",
    )


class OrbSlam3Settings(TimedPosesSettings, GivenPosesSettings):
    """A trajectory that ORB-SLAM2 or ORB-SLAM3 wrote."""

    kind: Literal["orbslam3"] = Field(
        default="orbslam3", description="a trajectory of ORB-SLAM2 or ORB-SLAM3, in TUM's or EuRoC's format"
    )
    path: Path | None = Field(
        default=None,
        description="the file, or its folder; empty: `CameraTrajectory.txt` or `KeyFrameTrajectory.txt`, in the "
        "images' folder or beside it",
    )


class StellaVslamSettings(TimedPosesSettings):
    """A map of stella_vslam."""

    kind: Literal["stella_vslam"] = Field(
        default="stella_vslam", description="a map of stella_vslam, and its trajectory of all frames"
    )
    path: Path | None = Field(
        default=None,
        description="the map, or its folder; empty: `map.msg` beside the images' folder or in it",
    )


class AriaSettings(TimedPosesSettings):
    """Trajectory and points of Project Aria's machine perception services (MPS)."""

    kind: Literal["aria"] = Field(
        default="aria", description="what Project Aria's machine perception services (MPS) wrote"
    )
    path: Path | None = Field(
        default=None,
        description="MPS's folder, its `slam` or `trajectory` folder, or one of the two trajectories; empty: looked "
        "for near the images",
    )
    camera: str = Field(default="camera-rgb", description="label of the camera in online_calibration.jsonl")
    max_points: int = Field(default=2000, ge=10, description="points that one frame is shown at most")
    max_inv_dist_std: float = Field(
        default=0.005, gt=0, description="points whose inverse distance is less certain [1/m] are left out"
    )
    max_dist_std: float = Field(
        default=0.05, gt=0, description="points whose distance is less certain [m] are left out"
    )


class ModpSettings(RecordedSettings):
    """The files of the paper's release."""

    kind: Literal["modp"] = Field(default="modp", description="the files of the paper's release")
    path: Path | None = Field(
        default=None,
        description="the file of poses, or its folder; empty: `trajectory.json` or `trajectory_orb.json`, in the "
        "images' folder or beside it",
    )


class ReplicaSettings(GivenPosesSettings):
    """The poses of a Replica sequence."""

    kind: Literal["replica"] = Field(default="replica", description="traj.txt of a Replica sequence")
    path: Path | None = Field(
        default=None, description="the file, or its folder; empty: `traj.txt` in the images' folder or beside it"
    )


class SevenScenesSettings(GivenPosesSettings):
    """The pose files of Microsoft's 7-Scenes."""

    # The files contain noisy poses of the depth camera.
    adjusts_by_default: ClassVar[bool] = True

    kind: Literal["sevenscenes"] = Field(default="sevenscenes", description="the pose files of Microsoft's 7-Scenes")
    path: Path | None = Field(
        default=None,
        description="folder with the `*.pose.txt`; empty: the images' folder, or `poses` in it or beside it",
    )
    adjust: bool | None = Field(
        default=None,
        description="without `points`: bundle adjust the poses with the triangulated points before the first frame; "
        "empty for true, since the poses are those of the depth camera",
    )


class SocketSettings(TrackerSettings):
    """Another program that sends frames and poses through a socket."""

    needs_source: ClassVar[bool] = False
    brings_cameras: ClassVar[bool] = True
    is_live: ClassVar[bool] = True

    kind: Literal["socket"] = Field(
        default="socket", description="another program, which sends frames and poses: docs/tracker_server.md"
    )
    address: str | None = Field(
        default=None, description="host:port to listen at; empty: 127.0.0.1:7007, which only this machine reaches"
    )
    path: Path | None = Field(
        default=None, description="a Unix socket to be made there, instead of `address`; empty for none"
    )
    patience: float = Field(
        default=120.0, gt=0, description="seconds without a whole message after which the stream counts as ended"
    )

    @model_validator(mode="after")
    def _listens_at_one_place(self) -> SocketSettings:
        if self.address is not None and self.path is not None:
            raise ValueError("tracker.address and tracker.path both say where to listen: take one out")
        return self


AnyTrackerSettings = Annotated[
    ColmapSettings
    | TransformsSettings
    | KltSettings
    | TumSettings
    | OrbSlam3Settings
    | StellaVslamSettings
    | AriaSettings
    | ModpSettings
    | ReplicaSettings
    | SevenScenesSettings
    | SocketSettings,
    Field(discriminator="kind"),
]
"""The type of the `tracker` section: a union of the models, discriminated by `kind`."""
