"""One run: frames from the tracker through the mapper to the files of the output folder."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from fields.backend import describe, initialise
from fields.camera import PinholeCamera
from fields.pose_correction import PoseCorrection
from fields.tracked_frame import TrackedFrame
from modp_ti.errors import InputError
from modp_ti.evaluation import evaluate, trajectory_errors
from modp_ti.interruption import Interruption, RunStopped
from modp_ti.lpips import open_lpips
from modp_ti.mapper import Mapper
from modp_ti.observer import Observer, Unobserved
from modp_ti.prefetch import FramesAhead
from modp_ti.progress import ProgressLine
from modp_ti.report.record import RunRecord
from modp_ti.results import Results, metrics_of
from modp_ti.run_clock import RunClock
from modp_ti.settings import SceneConfig
from modp_ti.snapshots import Keeper, Snapshot, replay
from modp_ti.trackers import Tracker, close, events, frame_count, may_read_ahead, open_tracker
from pipelines.stopwatch import Stopwatch, breakdown_percent

__all__ = ["build_mapper", "run_scene"]


def run_scene(config: SceneConfig, console: Console | None = None, resumed: Snapshot | None = None) -> Path:
    """Map the scene of `config` and write its output folder, which is returned.

    Nothing but snapshots is written before the map is finished; the files then appear together. resumed: where to go on
    from, instead of from the beginning. Raises InputError for input that cannot be used. Ctrl-C, once the frames are
    coming, ends it after the step that it is at: a snapshot and the map so far are written, then KeyboardInterrupt is
    raised, which says so.
    """
    with ExitStack() as held:
        return _run(config, console or Console(quiet=True), held, resumed)


def _run(config: SceneConfig, console: Console, held: ExitStack, resumed: Snapshot | None) -> Path:
    """`run_scene`; held: takes what is to be closed at its end, however it ends."""
    clock = RunClock()
    record = RunRecord()
    line = ProgressLine(console)
    observer = _open_observer(config, console, record, held)
    try:
        backend = initialise(config.device, config.threads, config.seed)
    except RuntimeError as error:
        raise InputError(str(error)) from None
    record.device = describe(backend)
    console.print(f"device: {record.device}", highlight=False, soft_wrap=True)
    tick = time.perf_counter()
    tracker = open_tracker(config, line.prepare)
    held.callback(close, tracker)
    ahead = config.source.prefetch if may_read_ahead(tracker) else 0
    stop = Interruption(lambda: console.print("stopping after this step; Ctrl-C again stops at once", highlight=False))
    with FramesAhead(events(tracker), ahead) as arriving:
        first = next(arriving, None)
        if first is None:
            raise InputError("the tracker delivered no frame: nothing to map")
        if isinstance(first, PoseCorrection):
            raise InputError("the tracker corrects poses before its first frame")
        prepared = time.perf_counter() - tick
        lpips, no_lpips = open_lpips(config.evaluation.lpips_weights, min(first.camera.width, first.camera.height))
        notes = [*tracker.notes, *([no_lpips] if no_lpips else [])]
        _say(notes, console, record)

        mapper = build_mapper(config, first.camera)
        watch = mapper.pipeline.stopwatch
        watch.seconds["track"] = prepared
        with line.working("compiling kernels (the first time on this machine takes longest)"):
            mapper.pipeline.compile()
        keeper = Keeper(config, mapper, record, clock, lambda text: _say([text], console, record))
        rest: Iterator[TrackedFrame | PoseCorrection] = chain([first], arriving)
        if resumed is not None:
            with line.working(f"reading again what {resumed.path} was made of"):
                replay(resumed, mapper, rest, keeper.digest)
            keeper.go_on_from(resumed)
        elif keeper.path.exists():
            _say([f"{keeper.path} is of an earlier run: the first one of this run takes its place"], console, record)
        observer.begin(mapper, frame_count(tracker))
        held.enter_context(stop)
        clock.begin_mapping()
        try:
            done = len(mapper.frames)
            line.start_mapping(frame_count(tracker), "reading" if config.mode == "offline" else "mapping", done)
            _map(mapper, _timed(rest, watch, stop), config, line, record, observer, keeper, stop)
        except RunStopped:
            raise _stopped(config, mapper, keeper) from None
        clock.end_mapping(observer.waited)
    # How a live tracker's frames ended.
    _say([note for note in tracker.notes if note not in notes], console, record)
    refused = {
        reason: count for reason, count in _left_out(tracker, mapper).items() if count and reason != "unreadable"
    }
    if refused:
        text = ", ".join(f"{count} {reason}" for reason, count in refused.items())
        _say([f"frames that did not touch the map (mapping.gate): {text}"], console, record)
    breakdown = breakdown_percent(watch.seconds, clock.mapping)
    frames, keyframes = mapper.frames, mapper.pipeline.keyframes
    if len(keyframes) == 0:
        raise InputError(
            f"no frame became a keyframe: none has {config.mapping.keyframes.min_points} tracked points; "
            "give a tracker with points or lower mapping.keyframes.min_points"
        )
    versions = {config.mode: keeper.online or mapper.version()}
    if config.refine.steps and config.mode != "offline":
        try:
            keeper.after_mapping()
            keeper.online = versions[config.mode]
            _refine(mapper, config, line, record, observer, keeper, stop)
        except RunStopped:
            raise _stopped(config, mapper, keeper) from None
        versions["refined"] = mapper.version()
    last = list(versions)[-1]
    observer.on_stage("evaluating the saved map")
    results = Results(config, frames)
    metrics = None
    try:
        with results.writing():
            # What is scored is what a reader of the file gets.
            with line.working("writing the map"):
                versions[last] = results.write_map(versions[last], keyframes, mapper.pipeline.near)

            def keep(stage: str, frame: TrackedFrame, render: NDArray[np.float32]) -> None:
                stop.check()
                line.evaluated()
                if stage == last:
                    results.write_frame(frame, render)

            line.start_evaluating(len(frames) * len(versions))
            try:
                with watch.measure("evaluate"), FramesAhead(tracker, ahead) as again:
                    scores = evaluate(mapper.pipeline, again, versions, lpips, keep)
            except RunStopped:
                scores = None  # the map is whole, its figures are not
            finally:
                line.stop()
            if scores is not None:
                ground_truth = getattr(tracker, "ground_truth", list)()
                caught = mapper.pipeline.caught()
                _say([caught.warning()] if caught.warning() else [], console, record)
                metrics = {
                    "keyframes": len(keyframes),
                    "gaussians": len(mapper.pipeline.gaussians),
                    "backend": backend,
                    "seed": config.seed,
                    "frames_per_second": round(len(frames) / clock.mapping, 4),
                    "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
                    "snapshots": {"written": keeper.written, "failed": keeper.failed, "resumed": keeper.resumed},
                    "guards": caught.counts(),
                    "frames_left_out": _left_out(tracker, mapper),
                    "lpips_note": no_lpips,
                    "breakdown_percent": breakdown,
                    **metrics_of(scores, versions, frames, watch.seconds | {"total": clock.total}),
                    **trajectory_errors(frames.T_tracked, versions[last].trajectory, ground_truth),
                }
                results.write_scores(scores, metrics)
                if config.export.report:
                    with line.working("writing the report"):
                        problem = results.write_report(record, metrics, scores, versions, keyframes, ground_truth)
                    _say([problem] if problem else [], console, record)
    except InputError as error:
        raise InputError(f"{error}{keeper.way_on()}") from None
    if metrics is None:
        results.remove_figures()
        more = f"; modp-ti run --resume {config.output} scores it" if keeper.path.is_file() else ""
        raise KeyboardInterrupt(f"interrupted: the finished map is in {config.output}, without its scores{more}")
    keeper.remove()
    line.summary(metrics)
    return config.output


def _left_out(tracker: Tracker, mapper: Mapper) -> dict[str, int]:
    """How many frames did not touch the map because something is wrong with them, by what."""
    gate = getattr(mapper.pipeline, "gate", None)
    return {"unreadable": len(getattr(tracker, "unreadable", ())), **({} if gate is None else gate.refused)}


def _stopped(config: SceneConfig, mapper: Mapper, keeper: Keeper) -> KeyboardInterrupt:
    """Leave a snapshot and the map so far; what is to be said of it."""
    resumable = keeper.keep()
    frames, keyframes = mapper.frames, mapper.pipeline.keyframes
    said = f"interrupted after {len(frames)} frames"
    if len(keyframes):
        results = Results(config, frames)
        try:
            with results.writing():
                results.write_map(mapper.version(), keyframes, mapper.pipeline.near)
        except InputError as error:
            raise InputError(f"{error}{keeper.way_on()}") from None
        results.remove_figures()
        said += f"; the map so far is in {config.output}"
    return KeyboardInterrupt(f"{said}; modp-ti run --resume {config.output} goes on" if resumable else said)


def _say(notes: Iterable[str], console: Console, record: RunRecord) -> None:
    """Show remarks, and keep them for the report."""
    for note in notes:
        console.print(f"note: {note}", highlight=False, soft_wrap=True, markup=False)
        record.notes.append(note)


def _open_observer(config: SceneConfig, console: Console, record: RunRecord, held: ExitStack) -> Observer:
    """The viewer where the scene asks for it; it is there before anything that takes minutes."""
    if not config.view.enabled:
        return Unobserved()
    # Imported here: viser is an extra.
    from modp_ti.viewer.live import LiveViewer

    viewer = LiveViewer(config.view, lambda text: _say([text], console, record))
    held.callback(viewer.close)
    console.print(f"viewer: {viewer.url}", highlight=False, soft_wrap=True)
    return viewer


def build_mapper(config: SceneConfig, camera: PinholeCamera) -> Mapper:
    """The mapper of the scene's mode, for images of this camera. Raises InputError where its settings do not fit."""
    settings = config.offline if config.mode == "offline" else config.mapping
    try:
        return Mapper(camera.width, camera.height, settings, config.seed)
    except ValueError as error:
        raise InputError(str(error)) from None


def _map(
    mapper: Mapper,
    arriving: Iterable[TrackedFrame | PoseCorrection],
    config: SceneConfig,
    line: ProgressLine,
    record: RunRecord,
    observer: Observer,
    keeper: Keeper,
    stop: Interruption,
) -> None:
    """Take all frames and corrections in, in their order, and finish the map. Raises RunStopped between two of them."""
    size = None
    record.begin()
    try:
        for frame in arriving:
            keeper.digest.add(frame)
            if isinstance(frame, PoseCorrection):
                mapper.correct(frame)
                continue
            size = size or (frame.camera.width, frame.camera.height)
            if (frame.camera.width, frame.camera.height) != size:
                raise InputError(
                    f"{frame.name} is {frame.camera.width}x{frame.camera.height}, the first frame {size[0]}x{size[1]}: "
                    "all images of a scene must have one size"
                )
            report = mapper.add(frame)
            line.frame(report)
            record.frame(frame.index, report)
            observer.on_frame(frame, report)
            keeper.after_frame()
        if config.mode == "offline":
            line.start_offline(config.offline.steps)

            def optimised(step: int, gaussians: int, psnr: float) -> None:
                line.optimised(step, gaussians, psnr)
                record.optimised(step, gaussians, psnr)
                observer.on_step("optimising", step, config.offline.steps, psnr)
                stop.check()

            mapper.finish(optimised)
        else:
            mapper.finish()
        stop.check()
    finally:
        line.stop()


def _refine(
    mapper: Mapper,
    config: SceneConfig,
    line: ProgressLine,
    record: RunRecord,
    observer: Observer,
    keeper: Keeper,
    stop: Interruption,
) -> None:
    """Refine the map, or go on with it. Raises RunStopped between two steps."""
    steps = config.refine.steps
    line.start_refining(steps, keeper.refined)

    def refined(step: int, psnr: float) -> None:
        line.refined(step, psnr)
        record.refined(step, psnr)
        observer.on_step("refining", step, steps, psnr)
        keeper.after_step(step, steps)
        stop.check()

    try:
        mapper.refine(steps, config.refine, refined, keeper.refined)
    finally:
        line.stop()


def _timed(
    frames: Iterator[TrackedFrame | PoseCorrection], watch: Stopwatch, stop: Interruption
) -> Iterator[TrackedFrame | PoseCorrection]:
    """The frames and corrections, the time that the mapper waits for each counted as reading."""
    while True:
        with watch.measure("read"), stop.waiting():
            frame = next(frames, None)
        if frame is None:
            return
        yield frame
