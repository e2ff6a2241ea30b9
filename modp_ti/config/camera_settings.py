"""The settings of cameras: intrinsics with lens distortion, Aria recordings, panoramas, and the topics of ROS bags."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from pipelines.settings import StrictModel


class IntrinsicsSettings(StrictModel):
    """The camera's intrinsics and lens distortion, in pixels of the stored images, turned as EXIF says."""

    fx: float | None = Field(
        default=None,
        gt=0,
        description="horizontal focal length in pixels of the stored images. If it is set, this section replaces the "
        "intrinsics that the source provides",
    )
    fy: float | None = Field(default=None, gt=0, description="vertical focal length; empty: the same as fx")
    cx: float | None = Field(
        default=None,
        description="horizontal principal point. Pixel centres are at +0.5: add 0.5 to a calibration by OpenCV or "
        "ROS. Empty: the image centre",
    )
    cy: float | None = Field(default=None, description="vertical principal point, as cx")
    k1: float = Field(default=0.0, description="radial distortion, as in OpenCV")
    k2: float = Field(default=0.0, description="as k1")
    p1: float = Field(default=0.0, description="tangential distortion, as in OpenCV")
    p2: float = Field(default=0.0, description="as p1")
    k3: float = Field(default=0.0, description="as k1")
    k4: float = Field(default=0.0, description="as k1; only with `fisheye`")
    fisheye: bool = Field(default=False, description="use OpenCV's fisheye model with k1 to k4")
    width: int | None = Field(
        default=None,
        ge=1,
        description="image width of the calibration. If it is set, the size of the images is checked",
    )
    height: int | None = Field(default=None, ge=1, description="image height of the calibration")

    @property
    def given(self) -> bool:
        """Whether the scene has this section."""
        return self.fx is not None

    @model_validator(mode="after")
    def _one_model(self) -> IntrinsicsSettings:
        if not self.given and self.model_fields_set - {"fx"} and self != IntrinsicsSettings():
            raise ValueError("source.intrinsics.fx is missing: set the focal length in pixels of the stored images")
        if self.fisheye and (self.p1 or self.p2):
            raise ValueError("source.intrinsics: OpenCV's fisheye model has no p1 and p2; remove them")
        if self.k4 and not self.fisheye:
            raise ValueError("source.intrinsics.k4 is only for `fisheye: true`; remove it")
        if (self.width is None) != (self.height is None):
            raise ValueError("source.intrinsics: set both width and height, or neither")
        return self


class VrsSettings(StrictModel):
    """The pinhole camera to which Aria's fisheye images are undistorted."""

    width: int = Field(default=800, ge=8, description="width of the undistorted image (Aria VRS only)")
    height: int = Field(default=800, ge=8, description="height of the undistorted image (Aria VRS only)")
    focal: float = Field(
        default=400.0,
        gt=0,
        description="focal length of the undistorted image in pixels; 400 at 800x800 is a field of view of 90 degrees",
    )


class PanoramaSettings(StrictModel):
    """Images that see all round, which are cut into square pinhole images, called faces."""

    projection: Literal["none", "equirectangular", "dual_fisheye"] = Field(
        default="none",
        description="`equirectangular`: images twice as wide as high; `dual_fisheye`: two circles side by side, the "
        "left one of the lens that looks forward; `none`: the images are not panoramas",
    )
    faces: int = Field(default=4, ge=1, le=12, description="number of faces around the horizon, the first one forward")
    up_down: bool = Field(default=False, description="two more faces, which look up and down")
    fov: float = Field(
        default=100.0,
        ge=30,
        le=120,
        description="field of view of a face in degrees. Neighbours overlap by `fov - 360 / faces`",
    )
    lens_fov: float = Field(
        default=190.0, ge=120, le=280, description="`dual_fisheye`: field of view of each circle in degrees"
    )

    @property
    def given(self) -> bool:
        """Whether the images are panoramas."""
        return self.projection != "none"

    @property
    def count(self) -> int:
        """Number of frames that an image gives."""
        return self.faces + 2 * self.up_down if self.given else 1

    @model_validator(mode="after")
    def _projection_is_named(self) -> PanoramaSettings:
        changed = (getattr(self, name) != field.default for name, field in PanoramaSettings.model_fields.items())
        if not self.given and any(changed):
            raise ValueError("source.panorama.projection is missing: set it to equirectangular or dual_fisheye")
        return self


class BagImagesSettings(StrictModel):
    """The topics of the images of a ROS bag."""

    image: str | None = Field(
        default=None, description="topic of the images; empty: the first one in colour, or else the first (bags only)"
    )
    camera_info: str | None = Field(
        default=None, description="topic of the camera's CameraInfo; empty: that beside the images (bags only)"
    )
