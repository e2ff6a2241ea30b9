"""A run from start to end: read frames from the tracker, map them, evaluate the map and write the output folder."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.runtime import process
from fields.runtime.backend import describe, initialise
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.build import EXPECTED, build_mapper, open_conductor, open_earlier_map, open_observer
from modp_ti.engine.conductor import Conductor, first_frame, fitting
from modp_ti.engine.earlier_map import EarlierMap
from modp_ti.engine.interruption import Interruption, RunStopped
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.prefetch import FramesAhead
from modp_ti.engine.recording import RecordedSession
from modp_ti.engine.remarks import remarks
from modp_ti.engine.results import Results, metrics_of
from modp_ti.engine.run_clock import RunClock, peak_memory_mb
from modp_ti.engine.snapshots import FILE, Checkpointer, Recovery, Snapshot, replay
from modp_ti.engine.unfinished import Unfinished
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import run_folder
from modp_ti.files.urls import without_secrets
from modp_ti.inputs.inspection.geometry import require_fitting
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.protocol import Event, Tracker
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.inputs.scene_paths import refuse_output_in_input
from modp_ti.inputs.timed_poses import open_ground_truth, true_poses
from modp_ti.outputs.evaluation import FrameScore, MapVersion, evaluate, trajectory_errors
from modp_ti.outputs.lpips import open_lpips
from modp_ti.outputs.progress import ProgressLine, StageProgress, TimeAfterMapping
from modp_ti.outputs.report.record import RunRecord, StepNote, mapped_psnr, retention
from pipelines.companions.block_files import BlockError
from pipelines.companions.pace import CompletePace
from pipelines.pipeline import breakdown_percent
from pipelines.settings import RefineSettings


def run_scene(
    config: SceneConfig,
    console: Console | None = None,
    resumed: Snapshot | None = None,
    replayed: RecordedSession | None = None,
    watch: Callable[[StageProgress], None] | None = None,
) -> Path:
    """Map a scene and write its output folder.

    The finished map appears in the folder first, its scores and the report after them. Files of either appear together.
    If the tracker has made further maps (`tracker.maps: all`), each is then mapped to a folder in the output folder.

    Args:
        config: The scene's settings.
        console: Receives progress and notes, None for no output.
        resumed: Snapshot to continue from, None to start from the first frame.
        replayed: Recorded session to repeat instead of opening the tracker, None for none.
        watch: Called with the progress of each stage whenever it changes, None for no calls.

    Returns:
        The output folder.

    Raises:
        InputError: If the input cannot be used.
        KeyboardInterrupt: After Ctrl-C, with a message. If mapping has begun, the current step is finished, and a
            snapshot and the map so far are written first.

    Example:
        Map a scene and read its scores:

            output = modp_ti.run_scene(modp_ti.load_scene("scene.yaml"))
            print((output / "metrics.json").read_text())
    """
    refuse_output_in_input(config, replayed=None if replayed is None else replayed.path)
    with run_folder(config.output, adopted=() if resumed is None else (FILE,)):
        with ExitStack() as held:
            line = ProgressLine(console or Console(quiet=True), watch)
            held.callback(line.stop)
            session = _Session(config, line, held, replayed)
            output, further = session.run(resumed), session.tracker.further_maps
        for place in range(2, 2 + further):
            session.line.note(f"map {place} of {1 + further}")
            run_scene(config.of_map(place), console, watch=watch)
    return output


class _Session:
    """A run in progress, with the state that its stages share. `held` closes the run's resources when it ends."""

    def __init__(
        self, config: SceneConfig, line: ProgressLine, held: ExitStack, replayed: RecordedSession | None
    ) -> None:
        self.config, self.line, self.held, self.replayed = config, line, held, replayed
        self.clock, self.record = RunClock(), RunRecord()
        self.truth = open_ground_truth(config.source.ground_truth)  # a missing file is reported before anything else
        # Opened first, as what follows may take minutes.
        self.observer = open_observer(config.view, self._say, self.line.insist, self.held)
        self.stop = Interruption(lambda: self.line.note("stopping after this step; Ctrl-C again stops at once"))
        try:
            self.backend = initialise(config.device, config.mapper_threads, config.seed)
        except RuntimeError as error:
            raise InputError(str(error)) from None
        self.record.device = describe(self.backend)
        self.line.note(f"device: {self.record.device}")
        self._say(*process.notes)
        self.compiling = 0.0  # [s]; 0 until the mapper is made
        # Set while the stream is opened.
        self.tracker: Tracker
        self.earlier: EarlierMap
        self.conductor: Conductor
        self.mapper: Mapper
        self.after_mapping: TimeAfterMapping
        self.checkpointer: Checkpointer
        self.unfinished: Unfinished

    def run(self, resumed: Snapshot | None) -> Path:
        """Run all stages and return the output folder."""
        self._map_the_stream(resumed)
        self._say(*remarks(self.mapper.pipeline))
        self.breakdown = breakdown_percent(self.mapper.pipeline.stopwatch.seconds, self.clock.mapping)
        try:
            with self.unfinished.naming_snapshot():
                versions = self._versions()
        except BlockError as error:
            raise self.unfinished.damaged(error) from None
        self._write(versions)
        return self.config.output

    # ---- the stream ------------------------------------------------------------------------------------------

    def _map_the_stream(self, resumed: Snapshot | None) -> None:
        """Open the tracker, make the mapper for its first frame, and map all frames, or those after `resumed`."""
        tick = time.perf_counter()
        self.held.enter_context(self.stop)
        self.earlier = open_earlier_map(self.config, self.line)
        tracker = self.replayed or open_tracker(self.config, self.line.prepare)
        self.held.callback(tracker.close)
        recovery = Recovery(self.config, tracker)
        self.held.callback(recovery.remove)
        recovery.write()
        if resumed is None and isinstance(tracker, ReplayedTracker) and not self.config.force:
            with self.line.working("checking the poses"):
                require_fitting(tracker)
        self.tracker = self.earlier.join(tracker)
        self.conductor = open_conductor(self.config, self.tracker, self.held)
        if self.config.is_realtime:  # the kernels are loaded while the tracker opens
            self._make_mapper(EXPECTED)
        self.config = self.config.resolved(self.tracker.scale)
        # At least one frame in a realtime run, so that the mapper sees whether a frame waits.
        self.ahead = max(self.config.source.prefetch if self.tracker.reads_ahead else 0, self.config.is_realtime)
        with FramesAhead(self.tracker, self.ahead) as arriving:
            undistorter = self.tracker.undistorter if self.config.is_realtime else None
            if undistorter is not None:  # larger images than expected: while the first frames are tracked
                self._make_mapper(undistorter.camera)
            first = first_frame(arriving)
            recovery.write()  # a server has nothing to keep before
            prepared = time.perf_counter() - tick - self.compiling
            side = min(first.camera.width, first.camera.height)
            self.lpips, self.no_lpips = open_lpips(self.config.evaluation.lpips_weights, side)
            notes = [*self.tracker.notes, *([self.no_lpips] if self.no_lpips else [])]
            self._say(*notes, *self.earlier.notes)
            self._make_mapper(first.camera)
            self.mapper.pipeline.stopwatch.seconds["track"] = prepared
            self._open_keeper(resumed, arriving)
            self.unfinished = Unfinished(self.config, self.mapper, self.tracker, self.checkpointer)
            self.observer.begin(self.mapper, self.tracker.frame_count)
            self.clock.begin_mapping()
            self.stop.begin()
            try:
                with self.unfinished.naming_snapshot():
                    self._map(arriving)
            except RunStopped:
                raise self.unfinished.interrupted() from None
            except BlockError as error:
                raise self.unfinished.damaged(error) from None
            scoring = self.mapper.pipeline.stopwatch.seconds.get("evaluate", 0.0)
            self.clock.end_mapping(self.observer.waited + scoring - self.earlier.seconds)
        self._say(*(note for note in self.tracker.notes if note not in notes))  # a live tracker adds some at its end

    def _make_mapper(self, camera: PinholeCamera) -> None:
        """Make the mapper for images of this camera, and for those of an earlier map, unless the present one does."""
        before, largest = self.tracker.before, self.tracker.largest
        width, height = max(camera.width, before.width, largest[0]), max(camera.height, before.height, largest[1])
        if self.compiling > 0.0:
            if self.mapper.takes(width, height):
                return
            initialise(self.config.device, self.config.mapper_threads, self.config.seed)  # frees the smaller one
        self.mapper = build_mapper(self.config, camera.resized(width, height), self.conductor.pace)
        self.mapper.frames.origin = self.tracker.origin
        began = time.perf_counter()
        with self.line.working("compiling kernels (the first time on this machine takes longest)"):
            self.mapper.pipeline.compile()
        self.compiling += time.perf_counter() - began

    def _open_keeper(self, resumed: Snapshot | None, arriving: FramesAhead[Event]) -> None:
        """Create the checkpointer. With `resumed`, restore the map and advance the stream to that position."""
        self.checkpointer = checkpointer = Checkpointer(self.config, self.mapper, self.record, self.clock, self._say)
        if resumed is not None:
            with self.line.working(f"reading again what {resumed.path} was made of"):
                replay(resumed, self.mapper, arriving, checkpointer.digest)
            self.earlier.recall(self.mapper)
            checkpointer.go_on_from(resumed)
            return
        if checkpointer.path.exists():
            self._say(f"{checkpointer.path} is of an earlier run: the first one of this run takes its place")
        with self.line.working(self.earlier.working):
            self.earlier.go_on(self.mapper, arriving, checkpointer.digest)

    def _map(self, arriving: FramesAhead[Event]) -> None:
        """Process all frames and corrections in order, and finish the map. Raises RunStopped between two of them."""
        mapper, line, offline = self.mapper, self.line, self.config.mode == "offline"
        after = self.after_mapping = TimeAfterMapping(self.config, mapper.pipeline)
        line.start(
            "reading" if offline else "mapping",
            self.tracker.frame_count,
            len(mapper.frames),
            lambda _: after.seconds(len(mapper.frames), self.tracker.frame_count),
        )
        self.record.begin()
        try:
            events = self.conductor.events(arriving, mapper, self.stop, self.observer.on_further_step)
            for frame in fitting(events, mapper):
                self.checkpointer.digest.add(frame)
                if isinstance(frame, PoseCorrection):
                    self.conductor.correct(mapper, frame)
                    continue
                self._add(frame)
                self.checkpointer.after_frame()
            if offline:
                line.start("optimising", self.config.offline.steps)
                mapper.finish(self._optimised)
            else:
                self._settle()
            self.stop.check()
        finally:
            line.stop()

    def _add(self, frame: TrackedFrame) -> None:
        """Map a frame, record it, and show it."""
        report = self.conductor.add(self.mapper, frame)
        status = self.conductor.status()
        self.line.frame(report, self.tracker.frame_count, status)
        # A realtime run has no time for the PSNR of new keyframes.
        scores = self.config.evaluation.scores and isinstance(self.conductor.pace, CompletePace)
        psnr = mapped_psnr(self.mapper.pipeline, report) if scores else None
        self.record.frame(frame.index, report, psnr, **self.conductor.note())
        self.observer.on_frame(frame, report, status)

    def _settle(self) -> None:
        """Finish an online map. Raises RunStopped between two steps."""
        keyframes, frames = len(self.mapper.pipeline.keyframes), len(self.mapper.frames)
        views = self.conductor.pace.last_views(keyframes)
        self.line.start("settling", views, later=lambda pace: self.after_mapping.after_passes(pace, keyframes, frames))
        self.mapper.finish(lambda done, size, psnr: self._after_step("settling", done, views, psnr, size))

    def _optimised(self, step: int, gaussians: int, psnr: float) -> None:
        """Callback after a step of the offline optimisation."""
        self.record.steps.append(StepNote(step, psnr, gaussians))
        self._after_step("optimising", step, self.config.offline.steps, psnr, gaussians)

    def _after_step(self, stage: str, step: int, steps: int | None, psnr: float, size: int | None = None) -> None:
        """Show a step of a stage after the last frame. Raises RunStopped if Ctrl-C has been pressed."""
        self.line.step(step, psnr, size)
        self.observer.on_step(stage, step, steps, psnr)
        self.stop.check()

    # ---- the finished map ------------------------------------------------------------------------------------

    def _versions(self) -> dict[str, MapVersion]:
        """Return the map before refinement and, if the settings ask for it, after. The last version is final."""
        config, checkpointer = self.config, self.checkpointer
        if len(self.mapper.pipeline.keyframes) == 0:
            raise InputError(
                f"no frame became a keyframe: none has {config.mapping.keyframes.min_points} tracked points; "
                "give a tracker with points or lower mapping.keyframes.min_points"
            )
        versions = {config.mode: checkpointer.online or self.mapper.version()}
        if config.refine.wanted and config.mode != "offline":
            checkpointer.after_mapping()
            checkpointer.online = versions[config.mode]
            try:
                self._refine(self.earlier.refinement(config.refine))
            except RunStopped:
                raise self.unfinished.interrupted() from None
            versions["refined"] = self.mapper.version()
        return versions

    def _refine(self, settings: RefineSettings) -> None:
        """Refine the map for the settings' steps or time. Raises RunStopped between two steps."""
        done, steps = self.checkpointer.refined, settings.steps if settings.seconds is None else None
        scores = self.after_mapping.scores(len(self.mapper.frames)) / settings.views  # in steps
        self.line.start("refining", steps, done, lambda step: step * scores)
        schedule = self.conductor.schedule(settings)
        try:
            self.mapper.refine(settings.steps, settings, partial(self._refined, steps), done, schedule)
        finally:
            self.line.stop()

    def _refined(self, steps: int | None, step: int, psnr: float) -> None:
        """Callback after a step of a refinement of so many steps, None for one by the clock."""
        self.record.steps.append(StepNote(step, psnr))
        self.checkpointer.after_step(step, steps)
        self._after_step("refining", step, steps, psnr)

    def _write(self, versions: dict[str, MapVersion]) -> None:
        """Write the map, evaluate it, and write the scores and the report."""
        pipeline, output = self.mapper.pipeline, self.config.output
        results = Results(self.config, self.mapper.frames, self.tracker.undistorter)
        last = list(versions)[-1]
        try:
            with results.writing_map(), self.line.working("writing the map"):
                results.write_map(versions[last], pipeline.keyframes, pipeline.near)
                self.conductor.write_session(results.folder, self.config)
        except InputError as error:
            raise InputError(f"{error}{self.unfinished.way_on(versions[last])}") from None
        self._say(*self.conductor.notes)
        self.conductor.saved()
        self.observer.on_stage("evaluating the saved map")
        more = f"; modp-ti run --resume {output} scores it" if self.checkpointer.path.is_file() else ""
        unscored = f"; the finished map is in {output}, without its scores{more}"
        try:
            with results.writing_figures():
                metrics = self._write_figures(self._score(versions, results), versions, results)
        except RunStopped:
            raise KeyboardInterrupt(f"interrupted{unscored}") from None
        except InputError as error:
            if not results.map_is_there:
                unscored = self.unfinished.way_on(versions[last])
            raise InputError(f"{error}{unscored}") from None
        self.checkpointer.remove()
        self.line.summary(metrics)

    def _score(self, versions: dict[str, MapVersion], results: Results) -> list[FrameScore]:
        """Score all frames and write the pictures of the last version. Raises RunStopped between two frames."""
        if not self.config.evaluation.scores:
            return []
        last = list(versions)[-1]

        def keep(stage: str, frame: TrackedFrame, render: NDArray[np.float32]) -> None:
            self.stop.check()
            self.line.advance()
            if stage == last:
                results.write_frame(frame, render)

        pipeline, frames = self.mapper.pipeline, self.mapper.frames
        self.line.start("evaluating the saved map", len(frames) * len(versions))
        try:
            with pipeline.stopwatch.measure("evaluate"), FramesAhead(frames.again(self.tracker), self.ahead) as again:
                mapped = filter(self.checkpointer.digest.has_image_of, again)
                scores = evaluate(pipeline, mapped, versions, self.lpips, keep)
        finally:
            self.line.stop()
        scored = {score.index for score in scores}
        missing = [name for index, name in zip(frames.index, frames.name, strict=True) if index not in scored]
        if not scored:
            raise InputError(f"{missing[0]} and all other images of the run are gone or have changed")
        if missing:
            many = f"{len(missing)} of {len(frames)} images are"
            self._say(f"{many} gone or have changed since they were mapped: no scores (the first: {missing[0]})")
        return scores

    def _write_figures(self, scores: list[FrameScore], versions: dict[str, MapVersion], results: Results) -> dict:
        """Write the scores, the metrics and the report, and return the metrics."""
        pipeline, frames, checkpointer = self.mapper.pipeline, self.mapper.frames, self.checkpointer
        truth: list[NDArray[np.float64]] = []  # of every frame, NaN where it is unknown; empty without ground truth
        if self.truth is not None:
            truth, note = true_poses(self.truth, frames.timestamp, self.tracker.before)
            self._say(*([note] if note else []))
        caught = pipeline.caught()
        if warning := caught.warning():
            self._say(warning)
        metrics = {
            "keyframes": len(pipeline.keyframes.selected),
            "views_between": len(pipeline.keyframes) - len(pipeline.keyframes.selected),
            "gaussians": len(list(versions.values())[-1].gaussians["position"]),
            "backend": self.backend,
            "seed": self.config.seed,
            "frames_per_second": round((len(frames) - self.tracker.before.frames) / self.clock.mapping, 4),
            "peak_memory_mb": peak_memory_mb(),
            "snapshots": {name: getattr(checkpointer, name) for name in ("written", "failed", "resumed")},
            "guards": caught.counts(),
            "frames_left_out": {"unreadable": len(self.tracker.unreadable), **pipeline.refused},
            **self.earlier.metrics,
            "lpips_note": self.no_lpips,
            "breakdown_percent": self.breakdown,
            "further_maps": self.tracker.further_maps,
            **metrics_of(scores, versions, frames, pipeline.stopwatch.seconds | {"total": self.clock.total}),
            "retention": retention(self.record.frames, scores),
            **self.conductor.metrics(),
            **trajectory_errors(frames.T_tracked, list(versions.values())[-1].trajectory, truth),
        }
        results.write_scores(scores, metrics)
        if self.config.export.report:
            with self.line.working("writing the report"):
                store = pipeline.keyframes
                mapped = {keyframe.index for keyframe in store.selected}
                problem = results.write_report(self.record, metrics, scores, versions, mapped, store.scene_depth, truth)
            if problem:
                self._say(problem)
        return metrics

    def _say(self, *notes: str) -> None:
        """Print notes, and keep them for the report."""
        for note in map(without_secrets, notes):
            self.line.note(f"note: {note}")
            self.record.notes.append(note)
