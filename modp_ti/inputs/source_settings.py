"""The settings of the images: where they come from, how they are selected, scaled and masked, and their cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

from pydantic import Field, SerializationInfo, field_serializer, field_validator, model_validator

from modp_ti.files.errors import InputError, shown_url
from pipelines.settings import StrictModel

LONGER_SIDE = 480
"""Longest side [px] of a mapped image where `source.scale` is `auto`."""

WITH_SECRETS = {"secrets": True}
"""Context of `model_dump` that keeps users, passwords and queries of URLs."""

NO_PATH = "source.path is missing: set it to the folder of the images"


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


def written(url: int | str | None, info: SerializationInfo) -> int | str | None:
    """What is written of a URL: its secrets only for the processes of a run, which ask for them in the context."""
    return shown_url(url) if isinstance(url, str) and info.context != WITH_SECRETS else url


class SourceSettings(StrictModel):
    """The source of the images, and how they are selected, scaled and masked."""

    kind: str = Field(
        default="auto",
        description="type of `path` or `stream`; `auto` detects it. `images`: a folder of images; `release`: the "
        "folder of an Aria sequence of the paper's release; `vrs`: a Project Aria recording; `bag`: a ROS bag; the "
        "others: data sets, and captures of phones (a table in docs/sources.md)",
    )
    path: Path | None = Field(
        default=None,
        description="folder of the images (including subfolders), data set, video file or recording; not for the "
        "tracker `socket`",
    )
    stream: int | str | None = Field(
        default=None,
        description="instead of `path`: number of a camera or URL of a stream, for live frames. `from-env:NAME` and "
        "`from-file:PATH` take the URL from an environment variable or a text file, which keeps its password secret",
    )
    realtime: bool = Field(
        default=False, description="deliver the images of a file or folder at the times of their time stamps"
    )
    intrinsics: IntrinsicsSettings = IntrinsicsSettings()
    vrs: VrsSettings = VrsSettings()
    panorama: PanoramaSettings = PanoramaSettings()
    bag: BagImagesSettings = BagImagesSettings()
    scale: Literal["auto"] | Annotated[float, Field(gt=0, le=1)] = Field(
        default="auto",
        description=f"factor on the width and height of every frame. `auto` makes the longer side {LONGER_SIDE} pixels "
        "if it is longer; images of the tracker `socket` keep their size",
    )
    holdout: int | None = Field(
        default=None,
        ge=2,
        description="n: frames 0, n, 2n, ... are used only for evaluation, of panoramas all their faces; empty: none",
    )
    fps: float = Field(
        default=30.0,
        gt=0,
        description="frames per second, for sources without time stamps: time = position in the folder / fps",
    )
    start: int = Field(default=0, ge=0, description="position of the first frame in the folder")
    stop: int | None = Field(default=None, ge=1, description="position after the last frame; empty: all frames")
    step: int = Field(default=1, ge=1, description="use every n-th frame")
    part: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=1)]] | None = Field(
        default=None,
        description="[first, end]: of the tracked frames, only those at the positions from `first` to before `end` are "
        "mapped. The whole recording is tracked, and the same frames are held out. Empty: all of them",
    )
    masks: Path | None = Field(
        default=None,
        description="folder of masks with the names and sizes of the images: white pixels are valid, black ones "
        "ignored; empty: no masks",
    )
    mask_colour: tuple[int, int, int] | None = Field(
        default=None, description="[red, green, blue] (0-255): pixels of this colour are ignored; empty: none"
    )
    mask_tolerance: int = Field(
        default=0,
        ge=0,
        le=255,
        description="largest difference from mask_colour per channel; use about 10 for JPEG images",
    )
    prefetch: int = Field(
        default=4,
        ge=0,
        description="number of frames that a second thread decodes, undistorts and downsamples in advance; 0: no "
        "thread. The map does not depend on it",
    )
    vignette: Path | None = Field(
        default=None,
        description="image of the share of light that reaches each pixel (white: all of it). With `vrs`: Aria's "
        "vignetting mask, which belongs to the recorded image. Empty: the vignette of the source, if it has one",
    )

    ground_truth: Path | None = Field(
        default=None,
        description="true trajectory of the camera in TUM's format, matched with the frames by time: used only for the "
        "trajectory errors (`ate_rmse`) in `metrics.json` and the report; empty for none",
    )

    _without_secrets = field_serializer("stream")(written)

    @property
    def follows_clock(self) -> bool:
        """Whether the images arrive by the clock instead of when they are asked for."""
        return self.realtime or self.stream is not None

    def scale_for(self, width: int, height: int) -> float:
        """Return the scale of images of this size: `scale` if it is a number, otherwise what `auto` chooses.

        Args:
            width: Width of the stored images [px].
            height: Height of the stored images [px].
        """
        return min(1.0, LONGER_SIDE / max(width, height)) if self.scale == "auto" else self.scale

    def require_path(self) -> Path:
        """Return `path`.

        Raises:
            InputError: If `path` is empty.
        """
        if self.path is None:
            raise InputError(NO_PATH)
        return self.path

    @field_validator("mask_colour")
    @classmethod
    def _colour_has_8_bits(cls, colour: tuple[int, int, int] | None) -> tuple[int, int, int] | None:
        if colour is not None and not all(0 <= value <= 255 for value in colour):
            raise ValueError(f"source.mask_colour must be three numbers from 0 to 255, not {list(colour)}")
        return colour

    @model_validator(mode="after")
    def _is_complete(self) -> SourceSettings:
        if self.stream is None and self.kind == "live":
            raise ValueError("source.stream is missing: set it to a camera number or a URL for `source.kind: live`")
        if self.stop is not None and self.stop <= self.start:
            raise ValueError(f"source.stop ({self.stop}) must be larger than source.start ({self.start})")
        if self.part is not None and self.part[1] <= self.part[0]:
            raise ValueError(f"source.part ends at {self.part[1]}, which must be larger than {self.part[0]}")
        return self


class Scene(Protocol):
    """What a tracker may know of the scene that it is opened for: the part of a `SceneConfig` that concerns inputs."""

    @property
    def source(self) -> SourceSettings: ...
    @property
    def tracker(self) -> Any: ...
    @property
    def output(self) -> Path: ...
    @property
    def seed(self) -> int: ...
    @property
    def tracks_beside_mapping(self) -> bool: ...
    @property
    def mapper_threads(self) -> int | None: ...
