"""The settings of a scene as one strict model, `SceneConfig`.

`modp_ti.config.scene_file` reads and writes its files. The section `source` is defined in
`modp_ti.inputs.source_settings`, `tracker` in `modp_ti.inputs.readers`; `evaluation`, `export` and `view` in
`modp_ti.config.output_settings`; `mapping`, `refine` and `offline` in `pipelines.settings`. What a single section can
decide alone, such as an empty range of frames, is decided by its model; which settings exclude each other, by
`EXCLUSIONS`.
"""

from __future__ import annotations

from functools import reduce
from operator import or_
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, field_serializer, model_validator

from fields.runtime.process import available_cores
from modp_ti.config.output_settings import EvaluationSettings, ExportSettings, ViewSettings
from modp_ti.inputs.reader import GivenPosesSettings, TrackerSettings
from modp_ti.inputs.readers import READERS, SOURCES
from modp_ti.inputs.source_settings import NO_PATH, SourceSettings, written
from pipelines.settings import MappingSettings, OfflineSettings, RefineSettings, StrictModel

SOURCE_KINDS = ("auto", "images", "video", "live", *SOURCES)

# Names of `used_settings` for frames that do not wait, the most telling first, and for a tracker by what it lacks.
CLOCK = ("source.stream", "source.realtime", "a live tracker", "mapping.pace: realtime")
TRACKED, RECORDED = "a tracker of images as they come", "a tracker of recordings"
CAMERAS, NO_PANORAMAS = "a tracker with cameras", "a tracker without panoramas"

EXCLUSIONS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    (
        "source.stream",
        ("source.path", "source.kind", "source.realtime"),
        "a stream is where the images come from, and always sets the pace",
    ),
    ("source.stream", (RECORDED,), "it needs recorded images; set source.path, or take tracker.kind: klt"),
    ("source.realtime", (RECORDED,), "it does not follow images as they arrive; take tracker.kind: klt"),
    ("source.intrinsics", (CAMERAS,), "it provides the camera of every image"),
    ("tracker.maps", CLOCK[:2], "it needs all images before the first is mapped; record them first"),
    (
        "source.panorama",
        ("source.stream", "source.realtime", "source.intrinsics", "source.masks", "source.vignette"),
        "a panorama is cut into faces, whose cameras are computed",
    ),
    (
        "source.panorama",
        (NO_PANORAMAS,),
        "it has no poses of panoramas; take sfm, transforms, tum, orbslam3, matrices or tanksandtemples",
    ),
    (
        "source.panorama",
        ("tracker.adjust", "onto", "parts", "source.part", CLOCK[-1]),
        "the faces of a panorama keep together, in one map",
    ),
    ("snapshot_every", ("mode: offline", *CLOCK), "a run resumes by reading its frames again; record them"),
    ("minutes", ("mode: offline", *CLOCK), "it shares a time among the keyframes of a recording"),
    (
        "minutes",
        ("onto", "parts", "source.part", "tracker.maps: all"),
        "it is the time of one run, from the images to one map",
    ),
    ("minutes", ("refine.seconds",), "the refinement gets what the keyframes leave of it"),
    ("onto", ("mode: offline", *CLOCK), "frames wait while they are located in the finished map; record them"),
    ("onto", ("tracker.maps: all",), "one map is continued: set tracker.maps to first, largest or a number"),
    ("onto", ("parts",), "parts make a new map"),
    ("parts", ("source.part",), "the whole recording is cut into parts"),
    *(
        (key, (TRACKED, "mode: offline", *CLOCK), "all poses are needed beforehand; take tracker.kind: sfm")
        for key in ("parts", "source.part")
    ),
)
"""A setting, those that it cannot be combined with, and why, by the names of `used_settings`."""

# The kinds are those of the readers: a new one is a file in `modp_ti.inputs.readers`.
if TYPE_CHECKING:
    AnyTracker = TrackerSettings
else:
    AnyTracker = Annotated[reduce(or_, READERS.values()), Field(discriminator="kind")]


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
    minutes: float | None = Field(
        default=None,
        gt=0,
        description="make the best map that so many minutes give on this machine, from the start of the command to the "
        "map in the output folder; scores and report come after. Sets the steps of the keyframes and of the refinement "
        "by the clock, so that two runs differ (docs/method.md). Empty: the steps of the settings",
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
    _without_secrets = field_serializer("snapshot_store")(written)

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
        whole = self.minutes is not None and self.export.session  # recorded from the first frame to the last
        return one and not whole and not (self.is_live or self.is_realtime or self.source.realtime)

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
        if self.source.kind not in SOURCE_KINDS:
            raise ValueError(f"source.kind: must be {', '.join(map(repr, SOURCE_KINDS))}, not {self.source.kind!r}")
        if self.source.path is None and self.source.stream is None and self.tracker.needs_source:
            raise ValueError(NO_PATH)
        refuse_exclusions(self)
        return self


def used_settings(scene: SceneConfig) -> dict[str, str]:
    """Return the settings of a scene that exclude others: by their names in `EXCLUSIONS`, how the user knows them."""
    source, tracker = scene.source, scene.tracker
    kind = f"tracker.kind: {tracker.kind}"
    maps = getattr(tracker, "maps", "first")
    adjusts = isinstance(tracker, GivenPosesSettings) and tracker.adjusts
    used: dict[str, bool | str] = {
        "source.path": source.path is not None,
        "source.kind": source.kind not in ("auto", "live") and f"source.kind: {source.kind}",
        "source.stream": source.stream is not None,
        "source.realtime": source.realtime,
        "source.intrinsics": source.intrinsics.given,
        "source.masks": source.masks is not None,
        "source.vignette": source.vignette is not None,
        "source.panorama": source.panorama.given,
        "source.part": source.part is not None,
        "tracker.maps": maps != "first" and f"tracker.maps: {maps}",
        "tracker.maps: all": maps == "all",
        "tracker.adjust": adjusts,
        TRACKED: (tracker.follows_streams or tracker.is_live) and kind,
        RECORDED: not tracker.follows_streams and kind,
        CAMERAS: tracker.brings_cameras and kind,
        NO_PANORAMAS: not tracker.places_panoramas and kind,
        "a live tracker": tracker.is_live and kind,
        "mapping.pace: realtime": scene.is_realtime,
        "mode: offline": scene.mode == "offline",
        "snapshot_every": bool(scene.snapshot_every),
        "minutes": scene.minutes is not None,
        "refine.seconds": scene.refine.seconds is not None,
        "onto": scene.onto is not None,
        "parts": scene.parts is not None,
    }
    return {name: name if shown is True else shown for name, shown in used.items() if shown}


def refuse_exclusions(scene: SceneConfig) -> None:
    """Raise ValueError for the first two settings of a scene that cannot be combined."""
    used = used_settings(scene)
    for key, others, why in EXCLUSIONS:
        for other in others:
            if key in used and other in used:
                raise ValueError(f"{key} cannot be combined with {used[other]}; remove one of them: {why}")
