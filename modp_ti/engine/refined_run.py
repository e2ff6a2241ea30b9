"""`refine_run`: refines the map of a finished run, and replaces its files by those of the refined map."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from fields.frames.tracked_frame import TrackedFrame
from fields.map.trajectory import Trajectory
from fields.runtime.backend import describe, initialise
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.mapper import build_mapper
from modp_ti.engine.results import Results, summary_of
from modp_ti.engine.second_visit import finished_map
from modp_ti.engine.snapshot import FILE
from modp_ti.files import read_json
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import require_usable, sole_use
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.outputs.evaluation import FrameScore, MapVersion, evaluate
from modp_ti.outputs.formats.run_files import read_scores, write_exposures
from modp_ti.outputs.formats.splats_ply import check_splats, write_splats
from modp_ti.outputs.lpips import open_lpips
from modp_ti.outputs.playback.finished_run import FinishedRun, open_run
from modp_ti.outputs.playback.run_frames import frames_of, kept_images, run_settings
from modp_ti.outputs.progress import ProgressLine
from modp_ti.outputs.report.record import RunRecord
from modp_ti.outputs.report.where_wrong import Motion
from pipelines.online import OnlineMapper
from pipelines.refinement import refine
from pipelines.render.renderer import RenderedView
from pipelines.whole.finished_map import go_on

# Steps of a refinement, if the run's settings ask for none.
STEPS = 1000
STAGE = "refined"


def refine_run(folder: Path, steps: int | None = None, console: Console | None = None) -> dict[str, Any]:
    """Refine the map of a finished run on all of its keyframes (Section 4.7).

    Poses and keyframes stay as they are. The files of the run are replaced at the end, together.

    Args:
        folder: Output folder of the run.
        steps: Number of steps; None for `refine.steps` of the run, or 1,000 if it has none.
        console: Receives progress and notes, None for no output.

    Returns:
        The content of the new `metrics.json`.

    Raises:
        InputError: If there is no finished run, its frames cannot be read again, or the files cannot be written. The
            run is then as it was.
        KeyboardInterrupt: After Ctrl-C. The run is then as it was.
    """
    folder = folder.expanduser().resolve()
    run = open_run(folder)
    config = refinable(run, steps)
    with sole_use(folder):
        require_usable(folder)
        metrics = read_json(folder / "metrics.json", "of a finished run")
        line = ProgressLine(console or Console(quiet=True))
        try:
            return _refined(run, config, metrics, line)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"interrupted: {folder} is as it was") from None


def refinable(run: FinishedRun, steps: int | None = None) -> SceneConfig:
    """Return the settings of a run, with those of this refinement. Raises InputError if it cannot go on."""
    config, folder = run_settings(run), run.folder
    if (folder / FILE).is_file() or not (folder / "metrics.json").is_file():
        raise InputError(f"{folder}: its run has not finished: modp-ti run --resume {folder} goes on with it")
    if config.mode == "offline":
        raise InputError(f"{folder}: an offline map is not refined: map it with more offline.steps")
    if (config.is_live or config.source.realtime) and kept_images(run) is None:
        raise InputError(
            f"{folder}: its frames were live and cannot be read again; such a run needs `export.images: true`"
        )
    update = {"steps": steps or config.refine.steps or STEPS, "seconds": None, "poses": False, "hold": 0.0}
    export = config.export.model_copy(update={"images": False})  # they stay as they are
    return config.model_copy(
        update={"output": folder, "refine": config.refine.model_copy(update=update), "export": export}
    )


def _refined(run: FinishedRun, config: SceneConfig, metrics: dict[str, Any], line: ProgressLine) -> dict[str, Any]:
    """Refine the map, score it, and write it."""
    try:
        backend = initialise(config.device, config.mapper_threads, config.seed)
    except RuntimeError as error:
        raise InputError(str(error)) from None
    mapper = mapper_of(run, config, line)
    began, before = time.perf_counter(), mapper.renderer.view_renders
    line.start("refining", config.refine.steps)
    try:
        refine(mapper, config.refine, lambda step, psnr: line.step(step, psnr))
    finally:
        line.stop()
    seconds = round(time.perf_counter() - began, 3)
    earlier = metrics["refined"] or metrics["online"]
    estimated = {view.index for view in mapper.keyframes if view.exposure is not None}
    version = MapVersion(
        mapper.all_gaussians(),
        list(run.poses),
        [mapper.keyframes.exposure_at(index) for index in range(len(run))],
        earlier["view_renders"] + mapper.renderer.view_renders - before,
    )
    results = Results(config, _delivered(run))
    with results.writing_figures():
        splats = results.folder / "splats.ply", version.gaussians, run.record.origin
        write_splats(*splats)
        check_splats(*splats)
        if estimated:
            times = run.timestamps.tolist()
            write_exposures(results.folder / "exposure.json", range(len(run)), times, version.exposures, estimated)
        scores = _score(run, config, mapper, version, results, line)
        metrics = {
            **metrics,
            STAGE: summary_of(scores, STAGE, version, {view.index for view in mapper.keyframes}),
            "gaussians": len(version.gaussians["position"]),
            "refinement": {"before": earlier, "steps": config.refine.steps, "seconds": seconds},
        }
        kept = [score for score in read_scores(run.folder / "scores.csv") if score.stage != STAGE]
        results.write_scores(kept + scores, metrics)
        if config.export.report:
            record = RunRecord(device=describe(backend))
            record.notes.append("refined by modp-ti refine, after the run that these figures are of")
            depth, keyframes = run.record.scene_depth, set(run.record.keyframes)
            problem = results.write_report(record, metrics, kept + scores, {STAGE: version}, keyframes, depth, [])
            if problem:
                line.note(f"note: {problem}")
    return metrics


def mapper_of(run: FinishedRun, config: SceneConfig, line: ProgressLine) -> OnlineMapper:
    """Return a mapper with the map of the run. Raises InputError if its map or its frames do not fit the settings."""
    mapper = build_mapper(config, run.cameras[0].resized(*run.size)).online
    frames = line.through("reading the frames", frames_of(run, run.mapped, line.prepare), len(run.mapped))
    try:
        go_on(mapper, finished_map(run, frames))
    except ValueError as error:
        raise InputError(f"{run.folder}: its map does not fit its settings: {error}") from None
    return mapper


def _delivered(run: FinishedRun) -> DeliveredFrames:
    """Return the metadata of the frames, without points. Their poses count as tracked."""
    held_out = set(run.record.held_out)
    trajectory = Trajectory()
    trajectory.restore({"index": np.arange(len(run)), "T": run.poses, "held_out": np.zeros(len(run), dtype=bool)})
    return DeliveredFrames(
        index=list(range(len(run))),
        name=run.names,
        timestamp=run.timestamps.tolist(),
        camera=run.cameras,
        held_out=[place in held_out for place in range(len(run))],
        trajectory=trajectory,
    )


def _score(
    run: FinishedRun,
    config: SceneConfig,
    mapper: OnlineMapper,
    version: MapVersion,
    results: Results,
    line: ProgressLine,
) -> list[FrameScore]:
    """Score all frames and write their pictures."""
    if not config.evaluation.scores:
        return []
    lpips, _ = open_lpips(config.evaluation.lpips_weights, min(run.size))

    def keep(_: str, frame: TrackedFrame, render: RenderedView) -> None:
        results.write_frame(frame, render, Motion.at(version.trajectory, run.record.keyframes, frame))

    def frames() -> Iterator[TrackedFrame]:
        yield from frames_of(run, range(len(run)), line.prepare)

    again = line.through("evaluating the refined map", frames(), len(run))
    return evaluate(mapper, again, {STAGE: version}, lpips, keep)
