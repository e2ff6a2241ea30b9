"""The `tracker` section of a scene: one model per `tracker.kind`, with only the keys of that kind.

To add a kind, write its model here, add it to `AnyTrackerSettings`, and open it in
`modp_ti.inputs.trackers.open_tracker`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from modp_ti.config.capture_settings import (
    ArkitScenesSettings,
    BagSettings,
    EurocSettings,
    KittiSettings,
    NerfCaptureSettings,
    PolycamSettings,
    Record3dSettings,
    ScannerAppSettings,
    ScanNetSettings,
    StrayScannerSettings,
)
from modp_ti.config.tracker_base_settings import (
    GivenPosesSettings,
    RecordedSettings,
    TimedPosesSettings,
    TrackerSettings,
)

__all__ = [
    "AnyTrackerSettings",
    "AriaSettings",
    "ColmapSettings",
    "KltSettings",
    "MatricesSettings",
    "ModpSettings",
    "OrbSlam3Settings",
    "ReplicaSettings",
    "SevenScenesSettings",
    "SfmSettings",
    "SocketSettings",
    "StellaVslamSettings",
    "TanksAndTemplesSettings",
    "TransformsSettings",
    "TumSettings",
]


class ColmapSettings(RecordedSettings):
    """A COLMAP model, binary or text."""

    brings_cameras: ClassVar[bool] = True

    kind: Literal["colmap"] = Field(default="colmap", description="a COLMAP model")
    path: Path | None = Field(
        default=None,
        description="folder with cameras, images and points3D, or the parent of such a folder `0`; empty: `sparse/0` "
        "or `sparse`, next to the images' folder or in it",
    )


class TransformsSettings(RecordedSettings):
    """A transforms.json of instant-ngp or nerfstudio."""

    brings_cameras: ClassVar[bool] = True
    places_panoramas: ClassVar[bool] = True

    kind: Literal["transforms"] = Field(
        default="transforms", description="a transforms.json of instant-ngp or nerfstudio"
    )
    path: Path | None = Field(
        default=None, description="the file or its folder; empty: `transforms.json` next to the images' folder or in it"
    )


class KltSettings(TrackerSettings):
    """The built-in tracker, which needs only the images."""

    follows_streams: ClassVar[bool] = True

    kind: Literal["klt"] = Field(default="klt", description="the built-in tracker, which uses only the images")
    loops: bool = Field(
        default=False,
        description="close loops, drift of scale included, where the camera comes back after a long way. Needs "
        "`pip install 'modp-ti[loops]'`, and a second core",
    )
    maps: Literal["first", "largest", "all"] | Annotated[int, Field(ge=1)] = Field(
        default="first",
        description="which map is mapped, where the track is lost and what follows shows no place of what was before. "
        "`first`: the first one of 8 keyframes or 60 frames, while the images arrive; `largest`: that with the most "
        "frames, so that all images are tracked before the first is mapped; `all`: the largest, and then each other of "
        "8 keyframes or 60 frames in a run of its own, to `map-2`, `map-3`, ... in the output folder; a number: the "
        "map of this place by size",
    )

    @property
    def place(self) -> int | None:
        """Place by size of the map that is mapped; None for the first one."""
        if isinstance(self.maps, int):
            return self.maps
        return None if self.maps == "first" else 1


class SfmSettings(TrackerSettings):
    """Structure from motion on the images, before the first frame is mapped."""

    places_panoramas: ClassVar[bool] = True

    kind: Literal["sfm"] = Field(
        default="sfm",
        description="structure from motion by pycolmap on the images alone; the model is kept in the output folder",
    )
    order: Literal["sequential", "unordered"] = Field(
        default="sequential",
        description="`sequential`: the images follow each other along a path, and each is matched with its neighbours "
        "and with images that look alike, which closes loops; `unordered`: only with images that look alike. Up to 60 "
        "images are all matched with each other",
    )
    mapper: Literal["incremental", "global"] = Field(
        default="incremental",
        description="`incremental`: place the images one after the other; `global`: all at once, which is faster for "
        "many images",
    )
    overlap: int = Field(default=10, ge=1, description="number of next images that an image is matched with")
    features: int = Field(default=4000, ge=100, description="largest number of features of an image")


class TumSettings(TimedPosesSettings, GivenPosesSettings):
    """A trajectory in TUM's format."""

    places_panoramas: ClassVar[bool] = True

    kind: Literal["tum"] = Field(default="tum", description="a trajectory in TUM format")
    path: Path | None = Field(
        default=None,
        description="the file or its folder; empty: `groundtruth.txt`, `trajectory.txt`, `CameraTrajectory.txt` or "
        "`KeyFrameTrajectory.txt`, in the images' folder or next to it",
    )


class OrbSlam3Settings(TimedPosesSettings, GivenPosesSettings):
    """A trajectory that ORB-SLAM2 or ORB-SLAM3 wrote."""

    places_panoramas: ClassVar[bool] = True

    kind: Literal["orbslam3"] = Field(
        default="orbslam3", description="a trajectory of ORB-SLAM2 or ORB-SLAM3, in TUM or EuRoC format"
    )
    path: Path | None = Field(
        default=None,
        description="the file or its folder; empty: `CameraTrajectory.txt` or `KeyFrameTrajectory.txt`, in the images' "
        "folder or next to it",
    )


class StellaVslamSettings(TimedPosesSettings):
    """A map of stella_vslam."""

    kind: Literal["stella_vslam"] = Field(
        default="stella_vslam", description="a map of stella_vslam and its trajectory of all frames"
    )
    path: Path | None = Field(
        default=None, description="the map or its folder; empty: `map.msg` next to the images' folder or in it"
    )


class AriaSettings(TimedPosesSettings):
    """Trajectory and points of Project Aria's machine perception services (MPS)."""

    kind: Literal["aria"] = Field(
        default="aria", description="output of Project Aria's machine perception services (MPS)"
    )
    path: Path | None = Field(
        default=None,
        description="MPS's folder, its `slam` or `trajectory` folder, or one of the two trajectories; empty: it is "
        "searched near the images",
    )
    camera: str = Field(default="camera-rgb", description="label of the camera in online_calibration.jsonl")
    max_points: int = Field(default=2000, ge=10, description="largest number of points of a frame")
    max_inv_dist_std: float = Field(
        default=0.005, gt=0, description="largest standard deviation of a point's inverse distance [1/m]"
    )
    max_dist_std: float = Field(default=0.05, gt=0, description="largest standard deviation of a point's distance [m]")


class ModpSettings(RecordedSettings):
    """The files of the paper's release."""

    kind: Literal["modp"] = Field(default="modp", description="the files of the paper's release")
    path: Path | None = Field(
        default=None,
        description="the file of poses or its folder; empty: `trajectory.json` or `trajectory_orb.json`, in the "
        "images' folder or next to it",
    )


class ReplicaSettings(GivenPosesSettings):
    """The poses of a Replica sequence."""

    kind: Literal["replica"] = Field(default="replica", description="traj.txt of a Replica sequence")
    path: Path | None = Field(
        default=None, description="the file or its folder; empty: `traj.txt` in the images' folder or next to it"
    )


class MatricesSettings(GivenPosesSettings):
    """Matrices, one per line."""

    places_panoramas: ClassVar[bool] = True

    kind: Literal["matrices"] = Field(
        default="matrices", description="text with a 3x4 or 4x4 matrix, camera to world, per line"
    )
    path: Path | None = Field(
        default=None,
        description="the file or its folder; empty: `poses.txt` or `traj.txt` in the images' folder or next to it",
    )


class TanksAndTemplesSettings(GivenPosesSettings):
    """The poses of Tanks and Temples."""

    places_panoramas: ClassVar[bool] = True

    kind: Literal["tanksandtemples"] = Field(
        default="tanksandtemples", description="a `.log` of Tanks and Temples or Redwood"
    )
    path: Path | None = Field(
        default=None, description="the file; empty: the only `*.log` in the images' folder or next to it"
    )


class SevenScenesSettings(GivenPosesSettings):
    """The pose files of Microsoft's 7-Scenes."""

    # The files contain noisy poses of the depth camera.
    adjusts_by_default: ClassVar[bool] = True

    kind: Literal["sevenscenes"] = Field(default="sevenscenes", description="the pose files of Microsoft's 7-Scenes")
    path: Path | None = Field(
        default=None,
        description="folder of the files `*.pose.txt`; empty: the images' folder, or `poses` in it or next to it",
    )
    adjust: bool | None = Field(
        default=None,
        description="without `points`: bundle adjust the poses with the triangulated points before the first frame. "
        "Empty: true, since the poses are those of the depth camera",
    )


class SocketSettings(TrackerSettings):
    """Another program that sends frames and poses through a socket."""

    needs_source: ClassVar[bool] = False
    brings_cameras: ClassVar[bool] = True
    is_live: ClassVar[bool] = True

    kind: Literal["socket"] = Field(
        default="socket", description="another program that sends frames and poses (docs/tracker_server.md)"
    )
    address: str | None = Field(
        default=None, description="host:port of the server; empty: 127.0.0.1:7007, which only this machine can reach"
    )
    path: Path | None = Field(
        default=None,
        description="path of a Unix socket that is created, or of the stream of a killed run; not with `address`",
    )
    patience: float = Field(
        default=120.0, gt=0, description="time [s] without a complete message after which the stream ends"
    )

    @model_validator(mode="after")
    def _listens_at_one_place(self) -> SocketSettings:
        if self.address is not None and self.path is not None:
            raise ValueError("tracker.address and tracker.path cannot both be set; remove one of them")
        return self


AnyTrackerSettings = Annotated[
    ColmapSettings
    | TransformsSettings
    | KltSettings
    | SfmSettings
    | TumSettings
    | OrbSlam3Settings
    | StellaVslamSettings
    | AriaSettings
    | ModpSettings
    | ReplicaSettings
    | MatricesSettings
    | TanksAndTemplesSettings
    | SevenScenesSettings
    | Record3dSettings
    | ScannerAppSettings
    | StrayScannerSettings
    | PolycamSettings
    | NerfCaptureSettings
    | EurocSettings
    | KittiSettings
    | ScanNetSettings
    | ArkitScenesSettings
    | BagSettings
    | SocketSettings,
    Field(discriminator="kind"),
]
"""The type of the `tracker` section: a union of the models, discriminated by `kind`."""
