"""`MergedParts`: the maps of the finished parts of a recording as the map that a run starts with."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.earlier_map import EarlierMap
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.snapshots.snapshot import StreamDigest
from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.many.parts import Part, part_config, parts_of, steps_in_part
from modp_ti.many.results import figures, last_stage
from modp_ti.many.scenes import finished_metrics
from modp_ti.outputs.formats.run_files import read_exposures
from modp_ti.outputs.playback.finished_run import FinishedRun, open_run
from pipelines.settings import RefineSettings
from pipelines.whole.merge import MappedPart


class MergedParts(EarlierMap):
    """Merges the maps of the parts of a recording, all of which must be finished.

    Args:
        config: The settings of the whole recording, with `parts`.
    """

    def __init__(self, config: SceneConfig) -> None:
        self._config = config
        self._parts: Sequence[Part] = []
        self._runs: list[FinishedRun] = []
        self._figures: list[dict[str, Any]] = []
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
        assert isinstance(tracker, ReplayedTracker), "SceneConfig refuses others"
        self._parts = parts_of(tracker, self._config)
        for part in self._parts:
            config = part_config(self._config, part)
            metrics = finished_metrics(config)
            if metrics is None:
                raise InputError(f"{config.output}: this part is not mapped: `modp-ti run SCENE --parts` maps it first")
            self._runs.append(open_run(config.output))
            self._figures.append(figures(metrics))
            self._view_renders.append(last_stage(metrics)["view_renders"])
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
        return max(of_run["seconds"] for of_run in self._figures)

    @property
    def working(self) -> str:
        return "merging the parts"

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
                    "seconds": of_run["seconds"],
                }
                for part, of_run, kept in zip(self._parts, self._figures, self._kept, strict=True)
            ]
        }

    def go_on(self, mapper: Mapper, arriving: Iterator[TrackedFrame | PoseCorrection], digest: StreamDigest) -> None:
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
            self._kept = mapper.merge(parts, frames())
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
