"""The output folder of a run, whose files move into place together, and its figures: time, memory, scores, remarks."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.runtime.engine import engine
from modp_ti.config.scene_file import dump_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.files.atomic import replace_text, write_picture
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import appearing, is_run_folder
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.inputs.sources.undistortion import Undistorter
from modp_ti.outputs.evaluation import FrameScore, MapVersion, summary
from modp_ti.outputs.formats.dataset import image_names, write_image
from modp_ti.outputs.formats.run_files import NOT_ALWAYS, write_map, write_scores
from modp_ti.outputs.formats.splats_ply import check_splats
from modp_ti.outputs.locating.vertical import by_gravity
from modp_ti.outputs.measuring import WORLD, read_world
from modp_ti.outputs.report.page import Album, ReportedRun, write_report
from modp_ti.outputs.report.record import RunRecord
from modp_ti.outputs.report.where_wrong import ErrorSurvey, Motion, Needles
from pipelines.companions.pace import CompletePace
from pipelines.online import OnlineMapper
from pipelines.pipeline import Pipeline
from pipelines.render.renderer import RenderedView
from pipelines.whole.coverage import SeenDepth

STAGES = ("compile", "read", "track", "select", "depth", "occupancy", "optimise", "refine", "evaluate")
# Map versions with a key in metrics.json; the value is null if the run did not make that version.
MAPS = ("online", "refined", "offline")
# Most frames that are asked where the map is thin.
LOOKS = 100
# What not every run has, or is only written after its scores.
OUTDATED = (*NOT_ALWAYS, WORLD, "metrics.json", "scores.csv", "report.html", "renders", "session.zip")


class Results:
    """Writes the output files of a run.

    Inside `writing_map` and `writing_figures`, files go to a temporary `folder` in `config.output`.

    Args:
        config: The scene's settings.
        frames: Metadata of all frames.
        undistorter: Undistorter of the first frame's image, None if it is not known.
    """

    def __init__(self, config: SceneConfig, frames: DeliveredFrames, undistorter: Undistorter | None = None) -> None:
        self.config = config
        self.frames = frames
        self.undistorter = undistorter
        self._names = image_names(frames.name, config.export.images)
        self._album = Album.of(frames.held_out)
        self._survey = ErrorSurvey(held_out=any(frames.held_out))
        self._world = {"unit": "m", "by": "the recording's poses"} if config.tracker.in_metres else {}
        self._world = self._world if config.onto is None else read_world(config.onto)
        # Of some frames, what they see of the map; by place among all frames.
        mapped = [place for place, held_out in enumerate(frames.held_out) if not held_out]
        looks = mapped[:: -(-len(mapped) // LOOKS) or 1]
        self._looks = {frames.index[place]: place for place in looks}
        self._seen: dict[int, SeenDepth] = {}

    @contextmanager
    def writing_map(self) -> Iterator[None]:
        """Move the files that are written inside this context to the output folder together, if no error occurred.

        Files of an earlier run that this map may not have are deleted from there. It raises InputError if the files
        cannot be written.
        """
        with appearing(self.config.output, OUTDATED) as self.folder:
            yield
            dump_scene(self.config, self.folder / "config.yaml")
            if self._world:
                replace_text(self.folder / WORLD, json.dumps(self._world, indent=2) + "\n")

    @contextmanager
    def writing_figures(self) -> Iterator[None]:
        """As `writing_map`, for scores, report and pictures of the map that is in the output folder."""
        with appearing(self.config.output, ("renders",)) as self.folder:
            (self.folder / "renders").mkdir()
            yield
            if not self.map_is_there:
                raise InputError(f"{self.config.output}: the finished map is gone")

    @property
    def map_is_there(self) -> bool:
        """Whether the map is in the output folder, after `writing_map`."""
        return is_run_folder(self.config.output) and (self.config.output / "splats.ply").is_file()

    def write_map(self, version: MapVersion, pipeline: Pipeline) -> None:
        """Write the map. Raises InputError if `splats.ply` is not read back as it was written."""
        self._write_map(self.folder, version, pipeline)
        with suppress(InputError):  # the recording may be gone by now
            path = self.config.source.path if self.config.onto is None else None
            found = by_gravity(path, np.array(self.frames.timestamp), np.stack(version.trajectory))
            if found is not None:
                tilt = float(np.degrees(found.deviation))
                self._world |= {"down": found.down.tolist(), "down_deviation": tilt}
        check_splats(self.folder / "splats.ply", version.gaussians, self.frames.from_origin)

    def elsewhere(self, version: MapVersion, pipeline: Pipeline) -> str:
        """Write the map to a new temporary folder, which stays; return the part of an error message that says so."""
        folder = None
        try:
            folder = Path(tempfile.mkdtemp(prefix="modp-ti-map-"))
            self._write_map(folder, version, pipeline)
            dump_scene(self.config, folder / "config.yaml")
        except OSError as error:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)
            return f"; nor can {tempfile.gettempdir()}: {error.strerror}, and the map is lost"
        return f"; the map is in {folder}"

    def _write_map(self, folder: Path, version: MapVersion, pipeline: Pipeline) -> None:
        store, near = pipeline.keyframes, pipeline.near
        write_map(folder, version, self.frames, self._names, store, near, self.undistorter)

    def write_frame(self, frame: TrackedFrame, render: RenderedView, motion: Motion | None) -> None:
        """Write the pictures of a frame, and keep what the report may show of it.

        The image is written if `export.images` is set. A held-out frame also gets a picture of image and render side by
        side.

        Args:
            frame: The frame.
            render: Its render, developed and clipped.
            motion: The camera's motion there, None if there is none.
        """
        if self.config.export.images:
            write_image(self.folder / "colmap", self._names[frame.index], frame)
        if frame.held_out:
            pair = np.round(np.hstack([frame.image, render.colour]) * 255.0).astype(np.uint8)
            write_picture(self.folder / "renders" / f"{frame.index:06d}.png", pair)
        if self.config.export.report:
            self._album.keep(frame.index, frame.image, render.colour)
            if (place := self._looks.get(frame.index)) is not None:
                self._seen[place] = SeenDepth.of(frame.T_camera_world, frame.camera, render)
            if motion is not None and frame.held_out == self._survey.held_out:
                self._survey.add(frame, render, motion)

    def write_scores(self, scores: list[FrameScore], metrics: dict) -> None:
        """Write `scores.csv` and `metrics.json`."""
        write_scores(self.folder / "scores.csv", scores)
        replace_text(self.folder / "metrics.json", json.dumps(metrics, indent=2) + "\n")

    def write_report(
        self,
        record: RunRecord,
        metrics: dict,
        scores: list[FrameScore],
        versions: dict[str, MapVersion],
        keyframes: Collection[int],
        scene_depth: float,
        truth: list[NDArray[np.float64]],
    ) -> str | None:
        """Write `report.html` from the parts of a `ReportedRun`.

        Returns:
            None, or one line that says why there is no report.
        """
        try:
            stage, version = list(versions.items())[-1]
            places = [place for place, index in enumerate(self.frames.index) if index in keyframes]
            views = [(self.frames.camera[place], version.trajectory[place]) for place in places]
            run = ReportedRun(
                config=self.config,
                record=record,
                metrics=metrics,
                scores=scores,
                versions=versions,
                tracked=self.frames.T_tracked,
                truth=truth,
                keyframes=places,
                scene_depth=scene_depth,
                comparisons=self._album.comparisons(
                    [score for score in scores if score.stage == stage], self.folder / "renders"
                ),
                survey=self._survey,
                needles=Needles.of(version.gaussians, views),
                seen=[replace(seen, T_camera_world=version.trajectory[place]) for place, seen in self._seen.items()],
            )
            write_report(self.folder / "report.html", run)
        except Exception as error:  # the map is finished; no error of the report may lose it
            return f"report.html could not be made: {error!r}"
        return None


def metrics_of(
    scores: list[FrameScore],
    versions: dict[str, MapVersion],
    fitted: Collection[int],
    frames: DeliveredFrames,
    seconds: dict[str, float],
) -> dict:
    """Return the entries of `metrics.json` about the engine, the maps, the reprojection errors and the time.

    Args:
        scores: Scores of all frames in all versions.
        versions: Map versions by name; the last one is the final map.
        fitted: Indices of the frames that the map was optimised on.
        frames: All frames, with their tracked points.
        seconds: Time of each stage and `total` [s].
    """
    points, camera = frames.points, frames.camera
    trajectories = {"": list(versions.values())[-1].trajectory, "_tracked": frames.T_tracked}
    errors = {name: points.reprojection_error(camera, poses) for name, poses in trajectories.items()}
    for name, poses in trajectories.items():
        places = points.placed_anew(camera, poses, frames.held_out)
        errors["_anew" + name] = points.reprojection_error(camera, poses, places)
    taken = {stage: seconds.get(stage, 0.0) for stage in STAGES}
    taken = {"total": seconds["total"], **taken, "other": seconds["total"] - sum(taken.values())}
    return {
        "engine": str(engine()),
        "frames": len(frames),
        "corrections": frames.corrections,
        **{stage: summary_of(scores, stage, versions[stage], fitted) if stage in versions else None for stage in MAPS},
        **{f"reprojection_error{name}": None if error is None else round(error, 4) for name, error in errors.items()},
        "seconds": {name: round(time, 3) for name, time in taken.items()},
    }


def summary_of(
    scores: list[FrameScore], stage: str, version: MapVersion, fitted: Collection[int]
) -> dict[str, dict | int]:
    """Mean scores of one version over all frames, the held-out and the fitted ones, with its size and cost."""
    of = [score for score in scores if score.stage == stage]
    return {
        "all": summary(of),
        "held_out": summary([score for score in of if score.held_out]),
        "fitted": summary([score for score in of if score.index in fitted]),
        "gaussians": len(version.gaussians["position"]),
        "view_renders": version.view_renders,
    }


def remarks(pipeline: Pipeline) -> list[str]:
    """Return one-line remarks about a map after its last frame: what was left out, and what a budget took away."""
    said = []
    refused = [f"{count} {why}" for why, count in pipeline.refused.items() if count]
    if refused:
        said.append(f"frames that did not touch the map (mapping.gate): {', '.join(refused)}")
    if not isinstance(pipeline, OnlineMapper):
        return said
    if pipeline.paging.problem is not None:
        said.append(f"{pipeline.paging.problem}; what had no room was left out")
    if isinstance(pipeline.pace, CompletePace):
        optimise, plan = pipeline.settings.optimise, pipeline.pace.plan(0, *pipeline.counts)
        if plan.steps < optimise.steps:
            said.append(
                f"the recording is long: its keyframes got about {plan.steps} instead of {optimise.steps} steps each "
                "(mapping.optimise.budget; --best has no limit)"
            )
    return said


class RunClock:
    """Measures the time of the whole run (`total`) and of its mapping (`mapping`) [s], including earlier processes.

    Args:
        began: Time by the clock when the run began [s], None for now.
        clock: Returns the time [s].
    """

    def __init__(self, began: float | None = None, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._began = clock() if began is None else began
        self._mapping_since: float | None = None
        self._before = self._mapped = 0.0

    @property
    def total(self) -> float:
        return self._before + self._clock() - self._began

    @property
    def mapping(self) -> float:
        now = self._clock()
        return self._mapped + (0.0 if self._mapping_since is None else now - self._mapping_since)

    def resume(self, total: float, mapping: float) -> None:
        """Set the time that the run took until its snapshot. Later time is not counted, as its work was lost."""
        self._before, self._mapped = total, mapping

    def begin_mapping(self) -> None:
        self._mapping_since = self._clock()

    def end_mapping(self, waited: float = 0.0) -> None:
        """Stop the mapping clock after the last frame.

        Args:
            waited: Time for which a person paused the mapping [s]. It is subtracted.
        """
        self._mapped, self._mapping_since = self.mapping - waited, None


def peak_memory_mb() -> float | None:
    """Return the peak memory of this process so far [10^6 bytes]; None on Windows."""
    try:
        import resource
    except ImportError:
        return None
    unit = 1 if sys.platform == "darwin" else 1024  # macOS counts bytes, Linux kibibytes
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6, 1)
