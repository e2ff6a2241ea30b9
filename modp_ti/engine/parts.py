"""A recording in parts: how it is cut, the settings of a part, and the finished parts as the map to start with.

`modp_ti.many.parts` maps them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from fields.frames.tracked_frame import TrackedFrame
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.second_visit import EarlierMap
from modp_ti.engine.snapshot import StreamDigest
from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Event, Tracker
from modp_ti.outputs.formats.run_files import read_exposures
from modp_ti.outputs.playback.finished_run import FinishedRun, finished_metrics, open_run
from modp_ti.outputs.report.facts import last_stage
from pipelines.select.keyframes import SeenPoints, covisibility
from pipelines.settings import RefineSettings
from pipelines.whole.merge import MappedPart, merge

# Least number of own frames of a part. A shorter one costs more to start than to map.
LEAST = 8
# How far a cut may lie from where the parts would be of equal length [shares of a part].
SLACK = 0.1
# Most frames that a part has beyond each of its ends [shares of a part].
MARGIN = 0.1
# Overlap with the frame at the cut, see `covisibility`, below which frames beyond it are of no use to a part.
SEES_TOO = 0.3


@dataclass(frozen=True)
class Part:
    """A part of a recording. Frames are named by their positions in it.

    Attributes:
        number: Number of the part, from 1.
        own: The frames that belong to it.
        frames: The frames that it is mapped from: its own, and those of its neighbours that see the same.
    """

    number: int
    own: range
    frames: range


def cut(views: Sequence[SeenPoints], parts: int) -> list[Part]:
    """Cut a recording into parts of about the same number of frames.

    Near where the parts would be equally long, each cut is made where the frames before and after it have the least in
    common. Each part also gets the frames beyond its cuts that see what its frames at the cut see.

    Args:
        views: What each frame sees.
        parts: Number of parts.

    Returns:
        The parts, in order. Each frame is an own frame of one of them.

    Raises:
        InputError: If the recording is too short for so many parts.
    """
    if len(views) < LEAST * parts:
        most = len(views) // LEAST
        instead = f"at most {most} parts" if most >= 2 else "no parts"
        raise InputError(f"the recording has {len(views)} frames, too few for {parts} parts: take {instead}")
    length = len(views) / parts
    margin = max(int(MARGIN * length), 1)
    slack = int(SLACK * length)
    cuts = [_best_cut(views, round(number * length), slack, margin) for number in range(1, parts)]
    ends = [0, *cuts, len(views)]
    return [
        Part(
            number,
            range(first, end),
            range(_before(views, first, margin), _after(views, end, margin)),
        )
        for number, (first, end) in enumerate(pairwise(ends), start=1)
    ]


def _best_cut(views: Sequence[SeenPoints], middle: int, slack: int, margin: int) -> int:
    """Return the position of the first frame after a cut near the middle.

    The frames a margin before and after it have the least in common. Of cuts where they have as little, that is taken
    whose two frames have the least, and then the nearest to the middle.
    """

    def common(place: int) -> tuple[float, float, int]:
        apart = covisibility(views[place - margin], views[place + margin - 1])
        return apart, covisibility(views[place - 1], views[place]), abs(place - middle)

    return min(range(middle - slack, middle + slack + 1), key=common)


def _before(views: Sequence[SeenPoints], first: int, margin: int) -> int:
    """Return the position of the first frame of a part whose own frames begin at `first`."""
    place = first
    while place > max(first - margin, 0) and covisibility(views[place - 1], views[first]) >= SEES_TOO:
        place -= 1
    return place


def _after(views: Sequence[SeenPoints], end: int, margin: int) -> int:
    """Return the position after the last frame of a part whose own frames end before `end`."""
    place = end
    while place < min(end + margin, len(views)) and covisibility(views[end - 1], views[place]) >= SEES_TOO:
        place += 1
    return place


# Folder of the parts in the output folder.
FOLDER = "parts"
# Share of the steps of a keyframe that it gets in its part. The refinement of the merged map gets the others: a part
# optimises what the merged map takes from another one as well, and the seams need the steps.
IN_PART = 0.25


def parts_of(tracker: Tracker, config: SceneConfig) -> list[Part]:
    """Cut the recording of a tracker into the parts of the settings.

    Raises:
        InputError: If it is too short for them.
    """
    assert config.parts is not None
    seen = [SeenPoints(frame.undistorter.camera, frame.T_camera_world, frame.points.xyz) for frame in tracker.frames]
    return cut(seen, config.parts)


def part_config(config: SceneConfig, part: Part) -> SceneConfig:
    """Return the settings of the run of a part. Refinement, scores and reports are for the merged map."""
    source = config.source.model_copy(update={"part": (part.frames.start, part.frames.stop)})
    optimise = config.mapping.optimise.model_copy(update={"steps": steps_in_part(config)})
    return config.model_copy(
        update={
            "source": source,
            "mapping": config.mapping.model_copy(update={"optimise": optimise}),
            "parts": None,
            "output": config.output / FOLDER / str(part.number),
            "refine": config.refine.model_copy(update={"steps": 0, "seconds": None}),
            "evaluation": config.evaluation.model_copy(update={"scores": False}),
            "export": config.export.model_copy(update={"images": False, "report": False}),
        }
    )


def steps_in_part(config: SceneConfig) -> int:
    """Return the steps of a keyframe in its part: all of them without a refinement of so many steps."""
    steps = config.mapping.optimise.steps
    return math.ceil(IN_PART * steps) if config.refine.wanted and config.refine.seconds is None else steps


class MergedParts(EarlierMap):
    """Merges the maps of the parts of a recording, all of which must be finished.

    Args:
        config: The settings of the whole recording, with `parts`.
    """

    working = "merging the parts"

    def __init__(self, config: SceneConfig) -> None:
        self._config = config
        self._parts: Sequence[Part] = []
        self._runs: list[FinishedRun] = []
        self._metrics: list[dict[str, Any]] = []
        self._view_renders: list[int] = []
        self._posed: list[str] = []  # names of all frames of the tracker
        self._names: list[str] = []  # of those that could be read
        self._kept: Sequence[int] = []
        self._rendered = 0  # views of the parts, and those that merging took

    def join(self, tracker: Tracker) -> Tracker:
        """Find the finished runs of the parts. The tracker stays as it is.

        Raises:
            InputError: If a part is not finished.
        """
        self._parts = parts_of(tracker, self._config)
        for part in self._parts:
            config = part_config(self._config, part)
            metrics = finished_metrics(config)
            if metrics is None:
                raise InputError(f"{config.output}: this part is not mapped: `modp-ti run SCENE --parts` maps it first")
            self._runs.append(open_run(config.output))
            self._metrics.append(metrics)
            self._view_renders.append(metrics[last_stage(metrics)]["view_renders"])
        read = {name for run in self._runs for name in run.names}
        self._posed = [frame.name for frame in tracker.frames]
        self._names = [name for name in self._posed if name in read]
        return tracker

    def refinement(self, settings: RefineSettings) -> RefineSettings:
        """Add the steps that are left to the merged map, before the rates decay, as they are those of mapping.

        With its parts, the map gets as many views as one run.
        """
        mapping = self._config.mapping
        optimise = mapping.optimise
        if steps_in_part(self._config) == optimise.steps:
            return settings
        counts = [self._own_keyframes(number) for number in range(len(self._parts))]
        whole = sum(count if optimise.budget is None else min(count, optimise.budget) for count in counts)
        views = whole * optimise.steps * mapping.views.per_step + optimise.last_views(sum(counts))
        further = max(views - self._rendered, 0) // settings.views
        steps = settings.steps + further
        return settings.model_copy(update={"steps": steps, "hold": further / steps})

    def _own_keyframes(self, number: int) -> int:
        """Return the number of keyframes of a part that are not beyond its cuts."""
        part, run = self._parts[number], self._runs[number]
        own = set(self._posed[part.own.start : part.own.stop])
        return sum(run.names[line] in own for line in run.record.keyframes)

    @property
    def seconds(self) -> float:
        """Time of the part that took longest, as if all were mapped at once [s]."""
        return max(of_run["seconds"]["total"] for of_run in self._metrics)

    @property
    def notes(self) -> list[str]:
        said = f"merging the maps of {len(self._parts)} parts"
        return [said if self._config.refine.wanted else f"{said}; refine.steps is 0, so that their seams stay"]

    @property
    def metrics(self) -> dict[str, Any]:
        return super().metrics | {
            "parts": [
                {
                    "frames": [part.frames.start, part.frames.stop],
                    "own": [part.own.start, part.own.stop],
                    "keyframes": of_run["keyframes"],
                    "gaussians": of_run["gaussians"],
                    "kept": kept,
                    "seconds": of_run["seconds"]["total"],
                }
                for part, of_run, kept in zip(self._parts, self._metrics, self._kept, strict=True)
            ]
        }

    def go_on(self, mapper: Mapper, arriving: Iterator[Event], digest: StreamDigest) -> None:
        def frames() -> Iterator[TrackedFrame]:
            for name, frame in zip(self._names, arriving, strict=True):
                assert isinstance(frame, TrackedFrame), "a recording in parts has no corrections"
                if frame.name != name:
                    raise ValueError(f"the part of {frame.name} did not have it")
                digest.add(frame)
                yield frame

        index = {name: place for place, name in enumerate(self._names)}
        parts = [self._mapped(number, index) for number in range(len(self._parts))]
        try:
            self._kept = merge(mapper.online, parts, mapper.noted(frames()))
            self._rendered = mapper.pipeline.renderer.view_renders
        except ValueError as error:
            raise InputError(
                f"{self._config.output}: the maps of the parts do not fit the recording ({error}): delete the folder "
                "parts, and map it again"
            ) from None

    def _mapped(self, number: int, index: Mapping[str, int]) -> MappedPart:
        """Return the map of a part. Its frames get their indices in the whole recording."""
        part, run = self._parts[number], self._runs[number]
        exposures = read_exposures(run.folder / "exposure.json")
        places = [index[name] for name in run.names]
        own = [index[name] for name in self._posed[part.own.start : part.own.stop] if name in index]
        return MappedPart(
            own=range(own[0], own[-1] + 1),
            gaussians=run.gaussians,
            keyframes=[places[line] for line in run.record.keyframes],
            poses=dict(zip(places, run.poses, strict=True)),
            exposures={places[line]: exposure for line, exposure in exposures.items()},
            scene_depth=run.record.scene_depth,
            view_renders=self._view_renders[number],
        )
