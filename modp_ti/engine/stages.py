"""The stages of a run before its results: open the recording, map its stream, finish the map.

Each of them is a function, and takes the frozen result of the one before.
"""

from __future__ import annotations

import time
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from typing import Any

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.runtime import process
from fields.runtime.backend import describe, initialise
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.cleaned import cleaned_at_the_end, said
from modp_ti.engine.interruption import Interruption
from modp_ti.engine.mapper import Mapper, build_mapper
from modp_ti.engine.parts import MergedParts
from modp_ti.engine.realtime import open_conductor
from modp_ti.engine.recording import RecordedSession
from modp_ti.engine.results import Results, RunClock, remarks
from modp_ti.engine.resume import Recovery, replay, saving
from modp_ti.engine.second_visit import EarlierMap, SecondVisit
from modp_ti.engine.snapshot import Checkpointer, Snapshot
from modp_ti.engine.stream import Conductor, FramesAhead, Observer, open_observer
from modp_ti.files.errors import InputError, without_secrets
from modp_ti.inputs.inspection.geometry import require_fitting
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.protocol import Event, Tracker
from modp_ti.inputs.timed_poses import TimedPoses, open_ground_truth
from modp_ti.outputs.evaluation import MapVersion
from modp_ti.outputs.lpips import Lpips, open_lpips
from modp_ti.outputs.progress import ProgressLine, TimeAfterMapping
from modp_ti.outputs.report.record import RunRecord, StepNote, mapped_psnr
from pipelines.companions.pace import CompletePace
from pipelines.pipeline import Pipeline, breakdown_percent

# The camera that the mapper of a realtime run is made for before the stream has opened. The images of most are smaller:
# `source.scale: auto` makes none of them larger than 480 pixels.
EXPECTED = PinholeCamera(640.0, 640.0, 320.0, 320.0, 640, 640)


# ---- the recording ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OpenRun:
    """A run whose tracker is open.

    Attributes:
        config: The settings, with the tracker's scale.
        line: Shows the progress.
        record: Notes for the report.
        clock: Time of the run, with that of earlier processes.
        backend: Name of the engine's backend.
        truth: True poses, None if they are not known.
        observer: Is notified of frames and steps.
        stop: Notes Ctrl-C.
        earlier: The map that the run starts with.
        tracker: The tracker, whose first frames are those of `earlier`.
        recovery: Keeps a scene file of what a live tracker keeps.
        conductor: Takes the frames to the mapper.
        began: `time.perf_counter()` when the tracker was opened [s].
        mapper: Mapper of a realtime run, which is made while the tracker opens; None for other runs.
    """

    config: SceneConfig
    line: ProgressLine
    record: RunRecord
    clock: RunClock
    backend: str
    truth: TimedPoses | None
    observer: Observer
    stop: Interruption
    earlier: EarlierMap
    tracker: Tracker
    recovery: Recovery
    conductor: Conductor
    began: float
    mapper: Mapper | None = None

    @property
    def ahead(self) -> int:
        """Number of frames that are read ahead: at least one in a realtime run, whose mapper sees whether one waits."""
        return max(self.config.source.prefetch if self.tracker.reads_ahead else 0, self.config.is_realtime)

    def say(self, *notes: str) -> None:
        """Print notes, and keep them for the report."""
        _say(self.line, self.record, *notes)

    def mapper_for(self, camera: PinholeCamera, present: Mapper | None = None) -> Mapper:
        """Return the present mapper if images of this camera, and those of an earlier map, fit it, or else a new one.

        Args:
            camera: Camera of the images.
            present: The present mapper, whose memory a new one takes; None if there is none.
        """
        config, before, largest = self.config, self.tracker.before, self.tracker.largest
        width, height = max(camera.width, before.width, largest[0]), max(camera.height, before.height, largest[1])
        if present is not None:
            if present.takes(width, height):
                return present
            initialise(config.device, config.mapper_threads, config.seed)  # frees the smaller one
        mapper = build_mapper(config, camera.resized(width, height), self.conductor.pace)
        mapper.frames.origin = self.tracker.origin
        with self.line.working("compiling kernels (the first time on this machine takes longest)"):
            mapper.pipeline.compile()
        return mapper


def open_run(
    config: SceneConfig,
    line: ProgressLine,
    held: ExitStack,
    resumed: Snapshot | None = None,
    replayed: RecordedSession | None = None,
    began: float | None = None,
) -> OpenRun:
    """Start the engine and open the recording of a run.

    Args:
        config: The scene's settings.
        line: Shows the progress.
        held: Closes the run's resources when it ends.
        resumed: Snapshot that the run continues from, None for a new run.
        replayed: Recorded session to repeat instead of opening the tracker, None for none.
        began: `time.perf_counter()` when the run began [s], None for now.

    Raises:
        InputError: If the device or the input cannot be used.
    """
    record, clock = RunRecord(), RunClock(began)

    def say(*notes: str) -> None:
        _say(line, record, *notes)

    truth = open_ground_truth(config.source.ground_truth)  # a missing file is reported before anything else
    observer = open_observer(config.view, say, line.insist, held)  # opened first, as what follows may take minutes
    try:
        backend = initialise(config.device, config.mapper_threads, config.seed)
    except RuntimeError as error:
        raise InputError(str(error)) from None
    record.device = describe(backend)
    line.note(f"device: {record.device}")
    say(*process.notes)
    since = time.perf_counter()
    stop = held.enter_context(Interruption(lambda: line.note("stopping after this step; Ctrl-C again stops at once")))
    if config.onto is not None:
        earlier: EarlierMap = SecondVisit(config, line)
    else:
        earlier = EarlierMap() if config.parts is None else MergedParts(config)
    tracker = replayed or open_tracker(config, line.prepare)
    held.callback(tracker.close)
    recovery = Recovery(config, tracker)
    held.callback(recovery.remove)
    recovery.write()
    if resumed is None and not config.force:
        with line.working("checking the poses"):
            require_fitting(tracker)
    tracker = earlier.join(tracker)
    conductor = open_conductor(config, tracker, held, lambda: clock.total)
    line.until = conductor.left
    run = OpenRun(
        config, line, record, clock, backend, truth, observer, stop, earlier, tracker, recovery, conductor, since
    )
    mapper = run.mapper_for(EXPECTED) if config.is_realtime else None  # while the tracker opens
    return replace(run, mapper=mapper, config=config.resolved(tracker.scale))


def _say(line: ProgressLine, record: RunRecord, *notes: str) -> None:
    for note in map(without_secrets, notes):
        line.note(f"note: {note}")
        record.notes.append(note)


# ---- the stream ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MappedStream:
    """A run whose frames are mapped.

    Attributes:
        run: The run.
        mapper: The mapper with the map.
        keeper: Writes snapshots.
        lpips: Measures LPIPS, None without its weights.
        no_lpips: Why there is no LPIPS, None if there is.
        later: Estimates the time of what follows.
    """

    run: OpenRun
    mapper: Mapper
    keeper: Checkpointer
    lpips: Lpips | None
    no_lpips: str | None
    later: TimeAfterMapping

    @property
    def pipeline(self) -> Pipeline:
        """The map."""
        return self.mapper.pipeline

    def results(self) -> Results:
        """Return what writes the frames and the map so far to the output folder."""
        return Results(self.run.config, self.mapper.frames, self.run.tracker.undistorter)

    def saving(self) -> AbstractContextManager[None]:
        """Return a context whose errors save the map so far, see `resume.saving`."""
        return saving(self.mapper, self.keeper, self.results)

    def after_step(self, stage: str, step: int, steps: int | None, psnr: float, size: int | None = None) -> None:
        """Show a step of a stage after the last frame. Raises RunStopped if Ctrl-C has been pressed."""
        self.run.line.step(step, psnr, size)
        self.run.observer.on_step(stage, step, steps, psnr)
        self.run.stop.check()


def map_stream(run: OpenRun, resumed: Snapshot | None = None) -> MappedStream:
    """Map all frames of a run, or those after a snapshot.

    Args:
        run: The run.
        resumed: The snapshot, None to start from the first frame.

    Raises:
        InputError: If the input cannot be used.
        KeyboardInterrupt: After Ctrl-C. The map so far is written first.
    """
    tracker, mapper, watch = run.tracker, run.mapper, run.clock
    with FramesAhead(tracker, run.ahead, None if tracker.live is None else tracker.close) as arriving:
        undistorter = tracker.undistorter if run.config.is_realtime else None
        if undistorter is not None:  # larger images than expected: while the first frames are tracked
            mapper = run.mapper_for(undistorter.camera, mapper)
        first = arriving.first_frame()
        run.recovery.write()  # a server has nothing to keep before
        compiled = 0.0 if mapper is None else mapper.pipeline.stopwatch.seconds["compile"]
        prepared = time.perf_counter() - run.began - compiled
        side = min(first.camera.width, first.camera.height)
        lpips, no_lpips = open_lpips(run.config.evaluation.lpips_weights, side)
        notes = [*tracker.notes, *([no_lpips] if no_lpips else [])]
        run.say(*notes, *run.earlier.notes)
        mapper = run.mapper_for(first.camera, mapper)
        mapper.pipeline.stopwatch.seconds["track"] = prepared
        keeper = _open_keeper(run, mapper, resumed, arriving)
        stream = MappedStream(run, mapper, keeper, lpips, no_lpips, TimeAfterMapping(run.config, mapper.pipeline))
        run.observer.begin(mapper, tracker.frame_count)
        watch.begin_mapping()
        run.stop.begin()
        with stream.saving():
            _map(stream, arriving)
        scoring = mapper.pipeline.stopwatch.seconds.get("evaluate", 0.0)
        watch.end_mapping(run.observer.waited + scoring - run.earlier.seconds)
    run.say(*(note for note in tracker.notes if note not in notes))  # a live tracker adds some at its end
    return stream


def _open_keeper(run: OpenRun, mapper: Mapper, resumed: Snapshot | None, arriving: FramesAhead[Event]) -> Checkpointer:
    """Return the checkpointer, after the map is restored or the earlier one is taken in, with its frames."""
    keeper = Checkpointer(run.config, mapper, run.record, run.clock, run.say)
    if resumed is not None:
        with run.line.working(f"reading again what {resumed.path} was made of"):
            replay(resumed, mapper, arriving, keeper.digest)
        run.earlier.recall(mapper)
        keeper.continue_from(resumed)
        return keeper
    if keeper.path.exists():
        run.say(f"{keeper.path} is of an earlier run: the first one of this run takes its place")
    with run.line.working(run.earlier.working):
        run.earlier.go_on(mapper, arriving, keeper.digest)
    return keeper


def _map(stream: MappedStream, arriving: FramesAhead[Event]) -> None:
    """Process all frames and corrections in order, and finish the map. Raises RunStopped between two of them."""
    run, mapper, pipeline = stream.run, stream.mapper, stream.pipeline
    config, line, tracker, conductor, frames = run.config, run.line, run.tracker, run.conductor, mapper.frames
    offline, what = config.mode == "offline", "reading" if config.mode == "offline" else "mapping"
    line.start(what, tracker.frame_count, len(frames), lambda _: stream.later.seconds(len(frames), tracker.frame_count))
    run.record.begin()
    try:
        for event in conductor.events(arriving, mapper, run.stop, run.observer.on_further_step):
            if isinstance(event, TrackedFrame) and not mapper.takes(event.camera.width, event.camera.height):
                images = pipeline.renderer.images
                raise InputError(
                    f"{event.name} is {event.camera.width}x{event.camera.height}, and frames of up to "
                    f"{images.max_width}x{images.max_height} were expected from the first ones: send the largest "
                    "images first, or one size"
                )
            stream.keeper.digest.add(event)
            if isinstance(event, PoseCorrection):
                conductor.correct(mapper, event)
                continue
            report = conductor.add(mapper, event)
            status = conductor.status()
            line.frame(report, tracker.frame_count, status)
            # A run that follows a clock has no time for the PSNR of new keyframes.
            scores = config.evaluation.scores and isinstance(conductor.pace, CompletePace)
            run.record.frame(event.index, report, mapped_psnr(pipeline, report) if scores else None, **conductor.note())
            run.observer.on_frame(event, report, status)
            stream.keeper.after_frame()
        keyframes = len(pipeline.keyframes)
        steps = config.offline.steps if offline else conductor.pace.last_views(keyframes)
        stage = "optimising" if offline else "settling"

        def after_step(step: int, gaussians: int, psnr: float) -> None:
            if offline:
                run.record.steps.append(StepNote(step, psnr, gaussians))
            stream.after_step(stage, step, steps, psnr, gaussians)

        line.start(
            stage,
            steps,
            later=None if offline else lambda pace: stream.later.after_passes(pace, keyframes, len(frames)),
        )
        mapper.finish(after_step)
        run.stop.check()
    finally:
        line.stop()


# ---- the finished map ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FinishedMap:
    """A run whose map is finished.

    Attributes:
        stream: The run with its mapped stream.
        versions: The map before refinement and, if the settings ask for it, after. The last version is final.
        breakdown: Share of each stage in the time of mapping [%].
        cleaned: What `mapping.clean` has removed, see `cleaned`; None if it has not looked.
    """

    stream: MappedStream
    versions: dict[str, MapVersion]
    breakdown: dict[str, float]
    cleaned: dict[str, Any] | None = None

    @property
    def last(self) -> MapVersion:
        """The final map."""
        return list(self.versions.values())[-1]


def finish_map(stream: MappedStream) -> FinishedMap:
    """Refine a map, if the settings ask for it.

    Raises:
        InputError: If there is no map, or it is damaged. What is left of it is written first.
        KeyboardInterrupt: After Ctrl-C. The map so far is written first.
    """
    run, mapper, keeper = stream.run, stream.mapper, stream.keeper
    config, line, seconds = run.config, run.line, stream.pipeline.stopwatch.seconds
    run.say(*remarks(stream.pipeline))
    breakdown = breakdown_percent(seconds, run.clock.mapping)
    with stream.saving():
        if len(stream.pipeline.keyframes) == 0:
            raise InputError(
                f"no frame became a keyframe: none has {config.mapping.keyframes.min_points} tracked points; "
                "give a tracker with points or lower mapping.keyframes.min_points"
            )
        versions = {config.mode: keeper.online or mapper.version()}
        if config.refine.wanted and config.mode != "offline":
            keeper.after_mapping()
            keeper.online = versions[config.mode]
            settings = run.earlier.refinement(config.refine)
            schedule = run.conductor.schedule(settings)
            steps = settings.steps if schedule is None else None
            scores = stream.later.scores(len(mapper.frames)) / settings.views  # in steps

            def after_step(step: int, psnr: float) -> None:
                run.record.steps.append(StepNote(step, psnr))
                keeper.after_step(step, steps)
                stream.after_step("refining", step, steps, psnr)

            line.start("refining", steps, keeper.refined, lambda step: step * scores)
            try:
                mapper.refine(settings.steps, settings, after_step, keeper.refined, schedule)
            finally:
                line.stop()
            versions["refined"] = mapper.version()
        entry = None
        if config.mapping.clean == "auto" and config.mode != "offline":
            stage, last = list(versions.items())[-1]
            with line.working("looking for faults"):
                entry = cleaned_at_the_end(mapper, run.tracker, last)
            run.say("mapping.clean: the map is larger than memory, and stays" if entry is None else said(entry))
            versions[stage] = replace(mapper.version(), view_renders=last.view_renders)
    return FinishedMap(stream, versions, breakdown, entry)
