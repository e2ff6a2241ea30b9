"""A run from start to end, in four stages: open the recording, map its stream, finish the map, write the results."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from fields.frames.tracked_frame import TrackedFrame
from modp_ti.config.scene_paths import refuse_output_in_input
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.interruption import RunStopped
from modp_ti.engine.recording import RecordedSession
from modp_ti.engine.results import Results, metrics_of, peak_memory_mb
from modp_ti.engine.second_tracker import better_tracker
from modp_ti.engine.snapshot import FILE, Snapshot
from modp_ti.engine.stages import FinishedMap, finish_map, map_stream, open_run
from modp_ti.engine.stream import FramesAhead
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import run_folder
from modp_ti.inputs.protocol import NothingPlacedError
from modp_ti.inputs.timed_poses import true_poses
from modp_ti.outputs.evaluation import FrameScore, evaluate, trajectory_errors
from modp_ti.outputs.progress import ProgressLine, StageProgress
from modp_ti.outputs.report.record import retention
from modp_ti.outputs.report.where_wrong import Motion
from pipelines.render.renderer import RenderedView


def run_scene(
    config: SceneConfig,
    console: Console | None = None,
    resumed: Snapshot | None = None,
    replayed: RecordedSession | None = None,
    watch: Callable[[StageProgress], None] | None = None,
    began: float | None = None,
) -> Path:
    """Map a scene and write its output folder.

    The finished map appears in the folder first, its scores and the report after them. Files of either appear together.
    Where the tracker has placed few images, they may be mapped anew with its second choice (`tracker.fallback`). If it
    has made further maps (`tracker.maps: all`), each is then mapped to a folder in the output folder.

    Args:
        config: The scene's settings.
        console: Receives progress and notes, None for no output.
        resumed: Snapshot to continue from, None to start from the first frame.
        replayed: Recorded session to repeat instead of opening the tracker, None for none.
        watch: Called with the progress of each stage whenever it changes, None for no calls.
        began: `time.perf_counter()` when the user asked for the run, from which `minutes` counts [s]; None for now.

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
    began = time.perf_counter() if began is None else began
    refuse_output_in_input(config, replayed=None if replayed is None else replayed.path)
    with run_folder(config.output, adopted=() if resumed is None else (FILE,)):
        with ExitStack() as held:
            line = ProgressLine(console or Console(quiet=True), watch)
            held.callback(line.stop)
            run = open_run(config, line, held, resumed, replayed, began)
            try:
                stream = map_stream(run, resumed)
            except NothingPlacedError:
                better = better_tracker(config, run, 0)
                if better is None:
                    raise
            else:
                with stream.saving():
                    better = better_tracker(config, run, len(stream.mapper.frames))
                if better is None:
                    write_results(finish_map(stream))
                else:
                    stream.keeper.remove()
            further = run.tracker.further_maps
        if better is not None:
            return run_scene(better, console, watch=watch, began=began)
        for place in range(2, 2 + further):
            line.note(f"map {place} of {1 + further}")
            run_scene(config.of_map(place), console, watch=watch)
    return config.output


def write_results(finished: FinishedMap) -> None:
    """Write the map, evaluate it, and write the scores and the report.

    Raises:
        InputError: If the files cannot be written; it names where the map is.
        KeyboardInterrupt: After Ctrl-C; it names where the map is.
    """
    stream, run = finished.stream, finished.stream.run
    pipeline, keeper, output, results = stream.pipeline, stream.keeper, run.config.output, stream.results()

    def way_on() -> str:
        return keeper.way_on() or results.elsewhere(finished.last, pipeline)

    try:
        with results.writing_map(), run.line.working("writing the map"):
            results.write_map(finished.last, pipeline)
            run.conductor.write_session(results.folder, run.config)
    except InputError as error:
        raise InputError(f"{error}{way_on()}") from None
    run.say(*run.conductor.saved())
    run.observer.on_stage("evaluating the saved map")
    more = f"; modp-ti run --resume {output} scores it" if keeper.path.is_file() else ""
    unscored = f"; the finished map is in {output}, without its scores{more}"
    try:
        with results.writing_figures():
            metrics = _write_figures(finished, results, _score(finished, results))
    except RunStopped:
        raise KeyboardInterrupt(f"interrupted{unscored}") from None
    except InputError as error:
        raise InputError(f"{error}{unscored if results.map_is_there else way_on()}") from None
    keeper.remove()
    run.line.summary(metrics)


def _score(finished: FinishedMap, results: Results) -> list[FrameScore]:
    """Score all frames and write the pictures of the last version. Raises RunStopped between two frames."""
    stream, run, versions = finished.stream, finished.stream.run, finished.versions
    if not run.config.evaluation.scores:
        return []

    pipeline, frames = stream.pipeline, stream.mapper.frames
    keyframes = [keyframe.index for keyframe in pipeline.keyframes.selected]

    def keep(stage: str, frame: TrackedFrame, render: RenderedView) -> None:
        run.stop.check()
        run.line.advance()
        if stage == list(versions)[-1]:
            results.write_frame(frame, render, Motion.at(finished.last.trajectory, keyframes, frame))

    run.line.start("evaluating the saved map", len(frames) * len(versions))
    try:
        with pipeline.stopwatch.measure("evaluate"), FramesAhead(frames.again(run.tracker), run.ahead) as again:
            scores = evaluate(pipeline, filter(stream.keeper.digest.has_image_of, again), versions, stream.lpips, keep)
    finally:
        run.line.stop()
    scored = {score.index for score in scores}
    missing = [name for index, name in zip(frames.index, frames.name, strict=True) if index not in scored]
    if not scored:
        raise InputError(f"{missing[0]} and all other images of the run are gone or have changed")
    if missing:
        many = f"{len(missing)} of {len(frames)} images are"
        run.say(f"{many} gone or have changed since they were mapped: no scores (the first: {missing[0]})")
    return scores


def _write_figures(finished: FinishedMap, results: Results, scores: list[FrameScore]) -> dict[str, Any]:
    """Write the scores, the metrics and the report, and return the metrics."""
    stream, run, versions = finished.stream, finished.stream.run, finished.versions
    pipeline, frames, keeper, tracker = stream.pipeline, stream.mapper.frames, stream.keeper, run.tracker
    truth: list[NDArray[np.float64]] = []  # of every frame, NaN where it is unknown; empty without ground truth
    if run.truth is not None:
        truth, note = true_poses(run.truth, frames.timestamp, tracker.before)
        run.say(*([note] if note else []))
    fitted = {view.index for view in pipeline.keyframes}
    caught = pipeline.caught()
    if warning := caught.warning():
        run.say(warning)
    metrics = {
        "keyframes": len(pipeline.keyframes.selected),
        "views_between": len(pipeline.keyframes) - len(pipeline.keyframes.selected),
        "gaussians": len(finished.last.gaussians["position"]),
        "backend": run.backend,
        "seed": run.config.seed,
        "frames_per_second": round((len(frames) - tracker.before.frames) / run.clock.mapping, 4),
        "peak_memory_mb": peak_memory_mb(),
        "snapshots": {name: getattr(keeper, name) for name in ("written", "failed", "resumed")},
        "guards": caught.counts(),
        "frames_left_out": {"unreadable": len(tracker.unreadable), **pipeline.refused},
        **run.earlier.metrics,
        "lpips_note": stream.no_lpips,
        "breakdown_percent": finished.breakdown,
        "further_maps": tracker.further_maps,
        "clean": finished.cleaned,
        **metrics_of(scores, versions, fitted, frames, pipeline.stopwatch.seconds | {"total": run.clock.total}),
        "retention": retention(run.record.frames, scores),
        **run.conductor.metrics(),
        **trajectory_errors(frames.T_tracked, finished.last.trajectory, truth),
    }
    results.write_scores(scores, metrics)
    if run.config.export.report:
        with run.line.working("writing the report"):
            store = pipeline.keyframes
            mapped = {keyframe.index for keyframe in store.selected}
            problem = results.write_report(run.record, metrics, scores, versions, mapped, store.scene_depth, truth)
        if problem:
            run.say(problem)
    return metrics
