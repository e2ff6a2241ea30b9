"""The settings of a scene as one strict model, `SceneConfig`.

`modp_ti.config.scene_file` reads and writes its files. The `tracker` section is defined in
`modp_ti.config.tracker_settings`; `mapping`, `refine` and `offline` are defined in `pipelines.settings`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator, model_validator

from modp_ti.config.tracker_settings import AnyTrackerSettings
from modp_ti.files.errors import InputError
from pipelines.settings import MappingSettings, OfflineSettings, RefineSettings, StrictModel

__all__ = [
    "EvaluationSettings",
    "ExportSettings",
    "IntrinsicsSettings",
    "SceneConfig",
    "SourceSettings",
    "ViewSettings",
    "VrsSettings",
]

NO_PATH = "source.path is missing: give the folder that holds the images"


class IntrinsicsSettings(StrictModel):
    """The camera's intrinsics and lens distortion, in pixels of the images as stored."""

    fx: float | None = Field(
        default=None,
        gt=0,
        description="focal length in pixels of the stored images; this section wins over what the source itself says "
        "of its camera. Empty for no such section",
    )
    fy: float | None = Field(default=None, gt=0, description="vertical focal length; empty for fx")
    cx: float | None = Field(
        default=None,
        description="principal point; pixel centres lie at +0.5, so add 0.5 to what OpenCV or ROS calibrated. "
        "Empty for the middle",
    )
    cy: float | None = Field(default=None, description="as cx")
    k1: float = Field(default=0.0, description="radial distortion, as in OpenCV")
    k2: float = Field(default=0.0, description="as k1")
    p1: float = Field(default=0.0, description="tangential distortion, as in OpenCV")
    p2: float = Field(default=0.0, description="as p1")
    k3: float = Field(default=0.0, description="as k1")
    k4: float = Field(default=0.0, description="as k1; with `fisheye` only")
    fisheye: bool = Field(default=False, description="k1 to k4 are those of OpenCV's fisheye model")
    width: int | None = Field(
        default=None, ge=1, description="width that this calibration is for; the images are then checked against it"
    )
    height: int | None = Field(default=None, ge=1, description="as width")

    @property
    def given(self) -> bool:
        """Whether the scene has this section."""
        return self.fx is not None

    @model_validator(mode="after")
    def _one_model(self) -> IntrinsicsSettings:
        if not self.given and self.model_fields_set - {"fx"} and self != IntrinsicsSettings():
            raise ValueError("source.intrinsics.fx is missing: the focal length in pixels of the stored images")
        if self.fisheye and (self.p1 or self.p2):
            raise ValueError("source.intrinsics: OpenCV's fisheye model has no p1 and p2; take them out")
        if self.k4 and not self.fisheye:
            raise ValueError("source.intrinsics.k4 is for `fisheye: true` alone; take it out")
        if (self.width is None) != (self.height is None):
            raise ValueError("source.intrinsics: give width and height, or neither")
        return self


class VrsSettings(StrictModel):
    """The pinhole camera to which Aria's fisheye images are undistorted."""

    width: int = Field(default=800, ge=8, description="width of the undistorted image (Aria VRS only)")
    height: int = Field(default=800, ge=8, description="height of the undistorted image (Aria VRS only)")
    focal: float = Field(default=400.0, gt=0, description="its focal length in pixels; 400 at 800x800 sees 90 degrees")


class SourceSettings(StrictModel):
    """The source of the images, and how they are selected, scaled and masked."""

    kind: Literal["auto", "images", "video", "live", "tum_rgbd", "replica", "sevenscenes", "release", "vrs"] = Field(
        default="auto",
        description="what `path` or `stream` is; `auto` recognises it. `images`: a folder of images; `release`: the "
        "folder of an Aria sequence as the paper's authors publish it; `vrs`: a Project Aria recording",
    )
    path: Path | None = Field(
        default=None,
        description="folder of the images (subfolders are searched too), data set, video file or recording "
        "(not used by `socket`)",
    )
    stream: int | str | None = Field(
        default=None,
        description="number of a camera, or URL of a stream, in the place of `path`: frames are taken live",
    )
    intrinsics: IntrinsicsSettings = IntrinsicsSettings()
    vrs: VrsSettings = VrsSettings()
    scale: float = Field(default=1.0, gt=0, le=1, description="factor on width and height of every frame")
    holdout: int | None = Field(
        default=None, ge=2, description="n sets aside frames 0, n, 2n, ... for evaluation; empty for none"
    )
    fps: float = Field(
        default=30.0,
        gt=0,
        description="frames per second: time stamp = position in the folder / fps, where the source has no times",
    )
    start: int = Field(default=0, ge=0, description="first frame, as position in the folder")
    stop: int | None = Field(default=None, ge=1, description="position after the last frame; empty for all")
    step: int = Field(default=1, ge=1, description="every n-th frame")
    masks: Path | None = Field(
        default=None,
        description="folder with one mask an image, of its name and size: white valid, black ignored; empty for none",
    )
    mask_colour: tuple[int, int, int] | None = Field(
        default=None, description="[red, green, blue] (0-255): pixels of this colour are ignored; empty for none"
    )
    mask_tolerance: int = Field(
        default=0,
        ge=0,
        le=255,
        description="difference per channel up to which a pixel has mask_colour; some 10 for JPEG",
    )
    prefetch: int = Field(
        default=4,
        ge=0,
        description="frames that a thread decodes, undistorts and halves ahead of the mapper; 0 for no thread. "
        "The map is the same",
    )
    vignette: Path | None = Field(
        default=None,
        description="image of how much light reaches each pixel, brightest where all does; with `vrs` Aria's "
        "vignetting mask, of the recorded image; empty for none, or for the source's own",
    )

    ground_truth: Path | None = Field(
        default=None,
        description="true trajectory of the camera in TUM's format, matched with the frames by time: used only for the "
        "trajectory errors (`ate_rmse`) in `metrics.json` and the report; empty for none",
    )

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
    def _one_place(self) -> SourceSettings:
        if self.stream is None and self.kind == "live":
            raise ValueError("source.stream is missing: `source.kind: live` needs a camera number or a URL")
        if self.stream is not None and self.kind not in ("auto", "live"):
            raise ValueError(f"source.stream is for `source.kind: live`, not {self.kind}; take one of them out")
        if self.stream is not None and self.path is not None:
            raise ValueError("source.path and source.stream cannot both be given; take one of them out")
        return self

    @model_validator(mode="after")
    def _range_is_not_empty(self) -> SourceSettings:
        if self.stop is not None and self.stop <= self.start:
            raise ValueError(f"source.stop ({self.stop}) must be larger than source.start ({self.start})")
        return self


class EvaluationSettings(StrictModel):
    """The evaluation of the finished map."""

    lpips_weights: Path | None = Field(
        default=None,
        description="folder with `alexnet-owt-7be5be79.pth` (torchvision) and `alex.pth` (the `lpips` package, v0.1); "
        "empty: torch's cache and the installed package; LPIPS is null where they are not",
    )


class ExportSettings(StrictModel):
    """Optional output files of a run."""

    images: bool = Field(
        default=False,
        description="write the undistorted images, as mapped, into `colmap/images`: to go on with elsewhere, since the "
        "cameras of `colmap/` are theirs",
    )
    report: bool = Field(
        default=True, description="write `report.html`: figures, curves, pictures and settings of the run on one page"
    )


class ViewSettings(StrictModel):
    """The live viewer."""

    enabled: bool = Field(
        default=False,
        description="serve a web page that shows the map as it grows (docs/viewer.md). `view: true` is short for it, "
        "and a section that says anything else means it too",
    )
    host: str = Field(
        default="127.0.0.1",
        description="address to serve at: this machine alone sees 127.0.0.1; 0.0.0.0 is for all that reach it",
    )
    port: int = Field(default=8080, ge=0, le=65535, description="port, or the next one that is free; 0 for any")
    paused: bool = Field(default=False, description="hold after the first frame until a browser says to go on")
    max_cost: float = Field(
        default=5.0,
        gt=0,
        le=100,
        description="percent of the mapping time that the viewer may take; it shows less instead",
    )
    max_splats: int = Field(
        default=100_000,
        ge=100,
        description="splats that a browser draws; of larger maps a subsample, grown to cover the rest",
    )

    @model_validator(mode="before")
    @classmethod
    def _short_form(cls, given: object) -> object:
        if isinstance(given, bool):
            return {"enabled": given}
        if isinstance(given, dict) and given and "enabled" not in given:
            return {"enabled": True, **given}
        return given


class SceneConfig(StrictModel):
    """All settings of a run; `load_scene` reads them from a `scene.yaml`.

    Examples:
        Build the settings in Python and map a COLMAP model:

            config = modp_ti.SceneConfig(
                source={"path": "room/images"}, tracker={"kind": "colmap"}, output="out/room", device="cpu"
            )
            modp_ti.run_scene(config)
    """

    source: SourceSettings = SourceSettings()
    tracker: AnyTrackerSettings
    output: Path = Field(description="folder of the results, made where it is missing")
    device: Literal["cpu", "cuda", "auto"] = Field(default="auto", description="`auto` takes CUDA where there is a GPU")
    mode: Literal["online", "offline"] = Field(
        default="online",
        description="`online` maps while frames arrive and then refines; `offline` is 3DGS on all frames at once",
    )
    seed: int = Field(default=0, ge=0, description="seed of all randomness")
    snapshot_every: int | None = Field(
        default=None,
        ge=0,
        description="frames after which everything is kept in `snapshot.npz`, for `modp-ti run --resume` after a crash "
        "or a power cut; empty or 0 for none. Ctrl-C keeps it in any case",
    )
    threads: int | None = Field(default=None, ge=1, description="CPU threads; empty for one per core")
    mapping: MappingSettings = MappingSettings()
    refine: RefineSettings = RefineSettings()
    offline: OfflineSettings = OfflineSettings()
    evaluation: EvaluationSettings = EvaluationSettings()
    export: ExportSettings = ExportSettings()
    view: ViewSettings = ViewSettings()

    @property
    def is_live(self) -> bool:
        """Whether the frames come from a live source and cannot be read again after the run."""
        return self.source.stream is not None or self.tracker.is_live

    @property
    def can_be_resumed(self) -> bool:
        """Whether a run can resume from a snapshot. Snapshots do not contain the frames, which are read again."""
        return self.mode == "online" and not self.is_live

    @model_validator(mode="after")
    def _snapshots_are_of_use(self) -> SceneConfig:
        if self.snapshot_every and not self.can_be_resumed:
            if self.mode != "online":
                raise ValueError(f"snapshot_every is for mode: online, not {self.mode}; take it out")
            raise ValueError(
                "snapshot_every: frames that come live are gone when the run is; record them, or take it out"
            )
        return self

    @model_validator(mode="after")
    def _source_and_tracker_fit(self) -> SceneConfig:
        source, tracker = self.source, self.tracker
        if source.path is None and source.stream is None and tracker.needs_source:
            raise ValueError(NO_PATH)
        if source.intrinsics.given and tracker.brings_cameras:
            raise ValueError(f"tracker.kind: {tracker.kind} brings its own cameras; take source.intrinsics out")
        if source.stream is not None and not tracker.follows_streams:
            raise ValueError(f"tracker.kind: {tracker.kind} cannot follow source.stream: it knows past images")
        return self
