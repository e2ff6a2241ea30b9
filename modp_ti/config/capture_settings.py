"""The settings of captures: recordings of phones, robots and data sets that bring their own poses."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from modp_ti.config.tracker_base_settings import TrackerSettings

__all__ = [
    "ArkitScenesSettings",
    "BagSettings",
    "CaptureSettings",
    "DepthCaptureSettings",
    "EurocSettings",
    "KittiSettings",
    "NerfCaptureSettings",
    "PolycamSettings",
    "Record3dSettings",
    "ScanNetSettings",
    "ScannerAppSettings",
    "StrayScannerSettings",
]


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
    depth: str | None = Field(
        default=None,
        description="topic of depth images (Image of encoding 16UC1 or 32FC1, or compressedDepth), each of which gives "
        "the image that was taken with it up to 400 points, or `none`; empty: the first such topic whose camera is "
        "known, unless `points` is set",
    )
    max_depth: float = Field(default=5.0, gt=0, description="largest depth [m] of a point of a depth image")
    max_points: int = Field(
        default=2000, ge=10, description="largest number of points of a frame that are taken from the clouds"
    )
    adjust: bool = Field(
        default=False,
        description="bundle adjust the poses with triangulated points before the first frame: for poses with errors of "
        "more than a pixel",
    )
