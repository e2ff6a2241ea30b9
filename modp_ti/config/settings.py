"""The settings of a scene as one strict model, `SceneConfig`.

`modp_ti.config.scene_file` reads and writes its files. The cameras of `source` are defined in
`modp_ti.config.camera_settings`, the `tracker` section in `modp_ti.inputs.readers`; `evaluation`, `export` and `view`
 in `modp_ti.config.output_settings`; `mapping`, `refine` and `offline` in `pipelines.settings`.
"""

from __future__ import annotations

from functools import reduce
from operator import or_
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, SerializationInfo, field_serializer, field_validator, model_validator

from fields.runtime.process import available_cores
from modp_ti.config.camera_settings import BagImagesSettings, IntrinsicsSettings, PanoramaSettings, VrsSettings
from modp_ti.config.combinations import refuse_exclusions
from modp_ti.config.output_settings import EvaluationSettings, ExportSettings, ViewSettings
from modp_ti.files.errors import InputError, shown_url
from modp_ti.inputs.reader import TrackerSettings
from modp_ti.inputs.readers import READERS, SOURCES
from pipelines.settings import MappingSettings, OfflineSettings, RefineSettings, StrictModel

__all__ = [
    "LONGER_SIDE",
    "WITH_SECRETS",
    "EvaluationSettings",
    "ExportSettings",
    "IntrinsicsSettings",
    "PanoramaSettings",
    "SceneConfig",
    "SourceSettings",
    "ViewSettings",
    "VrsSettings",
]

LONGER_SIDE = 480
"""Longest side [px] of a mapped image where `source.scale` is `auto`."""

WITH_SECRETS = {"secrets": True}
"""Context of `model_dump` that keeps users, passwords and queries of URLs."""

NO_PATH = "source.path is missing: set it to the folder of the images"


# The kinds are those of the readers: a new one is a file in `modp_ti.inputs.readers`.
if TYPE_CHECKING:
    AnySource = str
    AnyTracker = TrackerSettings
else:
    AnySource = Literal[("auto", "images", "video", "live", *SOURCES)]
    AnyTracker = Annotated[reduce(or_, READERS.values()), Field(discriminator="kind")]


def _written(url: int | str | None, info: SerializationInfo) -> int | str | None:
    """What is written of a URL: its secrets only for the processes of a run, which ask for them in the context."""
    return shown_url(url) if isinstance(url, str) and info.context != WITH_SECRETS else url


class SourceSettings(StrictModel):
    """The source of the images, and how they are selected, scaled and masked."""

    kind: AnySource = Field(
        default="auto",
        description="type of `path` or `stream`; `auto` detects it. `images`: a folder of images; `release`: the "
        "folder of an Aria sequence of the paper's release; `vrs`: a Project Aria recording; `bag`: a ROS bag; the "
        "others: data sets, and captures of phones (docs/trackers.md)",
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

    _without_secrets = field_serializer("stream")(_written)

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
    tracker: AnyTracker
    output: Path = Field(description="output folder, which is created if it does not exist")
    onto: Path | None = Field(
        default=None,
        description="output folder of a finished run whose map this recording continues (docs/second_visit.md): it "
        "is located there, and `output` gets the map of both. The finished run stays as it is. Empty: a new map",
    )
    parts: int | None = Field(
        default=None,
        ge=2,
        description="map the recording in so many parts, each in a separate process, and merge their maps "
        "(docs/scale.md). Empty: as one",
    )
    force: bool = Field(
        default=False, description="map even where given poses cannot be those of the images (`modp-ti check`)"
    )
    device: Literal["cpu", "cuda", "vulkan", "metal", "auto"] = Field(
        default="auto", description="`auto`: the GPU by CUDA, by Metal (macOS) or by Vulkan, otherwise the CPU"
    )
    mode: Literal["online", "offline"] = Field(
        default="online",
        description="`online`: map while frames arrive, then refine; `offline`: 3DGS with all frames at once",
    )
    seed: int = Field(default=0, ge=0, description="seed of all random numbers")
    snapshot_every: int | None = Field(
        default=None,
        ge=0,
        description="number of frames between snapshots of the run in `snapshot.npz`, for `modp-ti run --resume` after "
        "a crash; empty or 0: none. Ctrl-C always writes a snapshot",
    )
    snapshot_store: str | None = Field(
        default=None,
        description="URL of a folder for copies of the snapshots, such as `s3://bucket/room`, through fsspec: another "
        "machine continues from there (`modp-ti run SCENE --resume OUT`, `modp-ti batch --store`). `from-env:` and "
        "`from-file:` as for `source.stream`. Empty: none",
    )
    _without_secrets = field_serializer("snapshot_store")(_written)

    threads: int | None = Field(
        default=None,
        ge=1,
        description="number of CPU threads; empty: one per core, and one less where `klt` follows a clock next to the "
        "mapper",
    )
    mapping: MappingSettings = MappingSettings()
    refine: RefineSettings = RefineSettings()
    offline: OfflineSettings = OfflineSettings()
    evaluation: EvaluationSettings = EvaluationSettings()
    export: ExportSettings = ExportSettings()
    view: ViewSettings = ViewSettings()

    def resolved(self, scale: float) -> SceneConfig:
        """Return these settings with the given scale where `source.scale` is `auto`."""
        if self.source.scale != "auto":
            return self
        return self.model_copy(update={"source": self.source.model_copy(update={"scale": scale})})

    @property
    def tracks_beside_mapping(self) -> bool:
        """Whether the tracker runs in a process of its own."""
        return self.is_realtime and self.source.follows_clock and self.tracker.kind == "klt"

    @property
    def mapper_threads(self) -> int | None:
        """Number of CPU threads of the mapper; None for one per core. A tracker beside it gets one core."""
        if self.threads is not None or not self.tracks_beside_mapping:
            return self.threads
        return max(1, available_cores() - 1)

    @property
    def is_live(self) -> bool:
        """Whether the frames come from a live source and cannot be read again after the run."""
        return self.source.stream is not None or self.tracker.is_live

    @property
    def is_realtime(self) -> bool:
        """Whether the mapper keeps pace with the frames instead of giving each all its work."""
        if self.mode != "online" or self.mapping.pace != "auto":
            return self.mode == "online" and self.mapping.pace == "realtime"
        return self.source.realtime or self.is_live

    @property
    def can_be_resumed(self) -> bool:
        """Whether a run can resume from a snapshot. Snapshots do not contain the frames, which are read again."""
        one = self.mode == "online" and self.parts is None
        return one and not (self.is_live or self.is_realtime or self.source.realtime)

    def of_map(self, place: int) -> SceneConfig:
        """Return the settings of a run of its own for the map of this place by size, of tracker `klt`."""
        tracker = self.tracker.model_copy(update={"maps": place})
        return self.model_copy(update={"tracker": tracker, "output": self.output / f"map-{place}"})

    def without_clock(self) -> SceneConfig:
        """Return these settings for all images of a file or folder, however long their processing takes."""
        mapping = self.mapping.model_copy(update={"pace": "complete"})
        source = self.source.model_copy(update={"realtime": False})
        return self.model_copy(update={"source": source, "mapping": mapping})

    @model_validator(mode="after")
    def _can_be_run(self) -> SceneConfig:
        if self.source.path is None and self.source.stream is None and self.tracker.needs_source:
            raise ValueError(NO_PATH)
        refuse_exclusions(self)
        return self
