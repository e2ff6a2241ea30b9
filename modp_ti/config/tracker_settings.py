"""The `tracker` section of a scene: one model per `tracker.kind`, with only the keys of that kind.

To add a kind, write its model here, add it to `AnyTrackerSettings`, and open it in
`modp_ti.inputs.trackers.open_tracker`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from pipelines.settings import StrictModel

__all__ = [
    "AnyTrackerSettings",
    "AriaSettings",
    "ArkitScenesSettings",
    "BagSettings",
    "CaptureSettings",
    "ColmapSettings",
    "DepthCaptureSettings",
    "EurocSettings",
    "GivenPosesSettings",
    "KittiSettings",
    "KltSettings",
    "MatricesSettings",
    "ModpSettings",
    "NerfCaptureSettings",
    "OrbSlam3Settings",
    "PolycamSettings",
    "Record3dSettings",
    "RecordedSettings",
    "ReplicaSettings",
    "ScanNetSettings",
    "ScannerAppSettings",
    "SevenScenesSettings",
    "SfmSettings",
    "SocketSettings",
    "StellaVslamSettings",
    "StrayScannerSettings",
    "TanksAndTemplesSettings",
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
    places_panoramas: ClassVar[bool] = True

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


class CaptureSettings(TrackerSettings):
    """Base class for captures, whose cameras and poses come with the images of `source.path`."""

    brings_cameras: ClassVar[bool] = True

    adjust: bool = Field(
        default=False,
        description="bundle adjust the poses with triangulated points before the first frame: for poses with errors of "
        "more than a pixel",
    )


class DepthCaptureSettings(CaptureSettings):
    """Base class for captures with depth maps."""

    depth: bool = Field(
        default=True,
        description="take the tracked points from the depth maps, where there are some; false, and with `adjust`: "
        "triangulate them",
    )
    max_points: int = Field(default=400, ge=10, description="largest number of points of a frame from its depth map")
    max_depth: float = Field(default=5.0, gt=0, description="largest depth [m] that is used")


class Record3dSettings(DepthCaptureSettings):
    """A capture of Record3D."""

    kind: Literal["record3d"] = Field(
        default="record3d", description="a capture of Record3D, `.r3d` or its export of EXR and RGB files"
    )


class ScannerAppSettings(DepthCaptureSettings):
    """A capture of 3D Scanner App."""

    kind: Literal["scanner_app"] = Field(
        default="scanner_app", description='a capture of 3D Scanner App, exported as "All Data"'
    )


class StrayScannerSettings(DepthCaptureSettings):
    """A capture of Stray Scanner."""

    kind: Literal["stray_scanner"] = Field(default="stray_scanner", description="a capture of Stray Scanner")


class PolycamSettings(DepthCaptureSettings):
    """A raw export of Polycam."""

    kind: Literal["polycam"] = Field(default="polycam", description="a raw export of Polycam, a folder or zip")


class NerfCaptureSettings(CaptureSettings):
    """A capture of NeRFCapture."""

    kind: Literal["nerfcapture"] = Field(default="nerfcapture", description="a capture of NeRFCapture, a folder or zip")


class EurocSettings(CaptureSettings):
    """A sequence in EuRoC's layout."""

    kind: Literal["euroc"] = Field(default="euroc", description="the true poses of a sequence in EuRoC's layout")


class KittiSettings(CaptureSettings):
    """A sequence of KITTI odometry."""

    kind: Literal["kitti"] = Field(default="kitti", description="the true poses of a sequence of KITTI odometry")


class ScanNetSettings(DepthCaptureSettings):
    """A scene of ScanNet."""

    kind: Literal["scannet"] = Field(default="scannet", description="the poses of a scene of ScanNet")


class ArkitScenesSettings(DepthCaptureSettings):
    """A scene of ARKitScenes."""

    kind: Literal["arkitscenes"] = Field(default="arkitscenes", description="the poses of a scene of ARKitScenes")


class BagSettings(TrackerSettings):
    """Poses and points of a ROS bag."""

    kind: Literal["bag"] = Field(default="bag", description="the poses of a ROS bag")
    pose: str | None = Field(
        default=None,
        description="topic of the poses (Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped), or `tf` "
        "for the transforms alone; empty: the first topic of these types, or else `tf`",
    )
    world: str | None = Field(
        default=None, description="frame of the map; empty: that of the poses, or the root of the transforms"
    )
    body: str | None = Field(
        default=None,
        description="frame that the poses are of; empty: the messages' child_frame_id, or else that of the camera",
    )
    camera: str | None = Field(
        default=None,
        description="frame of the camera, with z forward and y down (the optical frame); empty: that of the images",
    )
    max_gap: float = Field(
        default=0.5,
        gt=0,
        description="largest time [s] between two poses, or two transforms, between which an image may lie",
    )
    points: str | None = Field(
        default=None,
        description="topic of the points (PointCloud2), or `none` to triangulate them; empty: the first such topic, if "
        "there is one",
    )
    max_points: int = Field(
        default=2000, ge=10, description="largest number of points of a frame that are taken from the clouds"
    )
    adjust: bool = Field(
        default=False,
        description="bundle adjust the poses with triangulated points before the first frame: for poses with errors of "
        "more than a pixel",
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
        default=None, description="path of a Unix socket that is created, instead of `address`; empty: none"
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
