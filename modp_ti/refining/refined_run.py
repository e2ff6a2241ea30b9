"""`write_refined`: scores a refined map, and replaces the files of its run by those of the refined map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.map.trajectory import Trajectory
from fields.runtime.backend import describe, initialise
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.build import build_mapper
from modp_ti.engine.results import Results, summary_of
from modp_ti.files.errors import InputError
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.outputs.evaluation import FrameScore, MapVersion, evaluate
from modp_ti.outputs.formats.exposure import write_exposures
from modp_ti.outputs.formats.scores_csv import read_scores
from modp_ti.outputs.formats.splats_ply import check_splats, write_splats
from modp_ti.outputs.lpips import open_lpips
from modp_ti.outputs.playback.finished_frames import frames_of
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.progress import ProgressLine
from modp_ti.outputs.report.record import RunRecord
from pipelines.finished_map import FinishedMap, take_in_frames
from pipelines.online import OnlineMapper

__all__ = ["RefinedMap", "write_refined"]

STAGE = "refined"


@dataclass(frozen=True)
class RefinedMap:
    """The result of a refinement.

    Attributes:
        gaussians: The Gaussians, in the form of `GaussianField.to_numpy`.
        exposures: Exposure (3, 4) by position of the frame; empty if none is estimated.
        estimated: Positions of the frames whose exposure was estimated. The others are interpolated.
        view_renders: Number of views that were rendered and differentiated.
        figures: What `metrics.json` says of the refinement.
    """

    gaussians: dict[str, NDArray]
    exposures: dict[int, NDArray[np.float64]]
    estimated: set[int]
    view_renders: int
    figures: dict[str, Any]

    def exposures_of(self, frames: int) -> list[NDArray[np.float64] | None]:
        """Return the exposure of each of so many frames; None without estimated ones."""
        if not self.estimated:
            return [self.exposures.get(index) for index in range(frames)]
        known = sorted(self.estimated)
        values = np.array([self.exposures[index] for index in known]).reshape(len(known), 12)
        columns = [np.interp(np.arange(frames), known, column) for column in values.T]
        return list(np.stack(columns, axis=1).reshape(frames, 3, 4))


def write_refined(
    run: FinishedRun, config: SceneConfig, refined: RefinedMap, metrics: Mapping[str, Any], line: ProgressLine
) -> dict[str, Any]:
    """Score a refined map and write it. All files appear in the output folder together.

    These are `splats.ply`, `exposure.json` where exposures are estimated, and scores, pictures and report. The other
    files of the run are those of the refined map too.

    Args:
        run: The run.
        config: Its settings, with those of the refinement.
        refined: The map.
        metrics: Content of the run's `metrics.json`.
        line: Shows the progress.

    Returns:
        The content of the new `metrics.json`.

    Raises:
        InputError: If the files cannot be written, or the frames not be read.
    """
    try:
        backend = initialise(config.device, config.mapper_threads, config.seed)
    except RuntimeError as error:
        raise InputError(str(error)) from None
    export = config.export.model_copy(update={"images": False})  # they stay as they are
    results = Results(config.model_copy(update={"export": export}), _delivered(run))
    earlier = "refined" if metrics["refined"] is not None else "online"
    with results.writing_figures():
        splats = results.folder / "splats.ply", refined.gaussians, run.record.origin
        write_splats(*splats)
        check_splats(*splats)
        exposures = refined.exposures_of(len(run))
        if refined.estimated:
            write_exposures(
                results.folder / "exposure.json", range(len(run)), run.timestamps.tolist(), exposures, refined.estimated
            )
        version = MapVersion(
            refined.gaussians,
            list(run.poses),
            exposures,
            metrics[earlier]["view_renders"] + refined.view_renders,
        )
        scores = _score(run, config, version, results, line)
        metrics = {
            **metrics,
            STAGE: summary_of(scores, STAGE, version),
            "gaussians": len(version.gaussians["position"]),
            "regions": {"before": metrics[earlier], **refined.figures},
        }
        before = [score for score in read_scores(run.folder / "scores.csv") if score.stage != STAGE]
        results.write_scores(before + scores, metrics)
        if config.export.report:
            record = RunRecord(device=describe(backend))
            count = len(refined.figures["rounds"])
            record.notes.append(f"refined in {count} rounds by modp-ti refine, after the run that these figures are of")
            depth, keyframes = run.record.scene_depth, set(run.record.keyframes)
            problem = results.write_report(record, metrics, before + scores, {STAGE: version}, keyframes, depth, [])
            if problem:
                line.note(f"note: {problem}")
    return metrics


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
    run: FinishedRun, config: SceneConfig, version: MapVersion, results: Results, line: ProgressLine
) -> list[FrameScore]:
    """Score all frames and write their pictures."""
    if not config.evaluation.scores:
        return []
    lpips, _ = open_lpips(config.evaluation.lpips_weights, min(run.size))
    still = config.mapping.model_copy(update={"transients": False})  # masks would need all keyframes
    camera = run.cameras[0].resized(*run.size)
    pipeline = build_mapper(config.model_copy(update={"mapping": still}), camera).pipeline
    assert isinstance(pipeline, OnlineMapper), "`refine` refuses other maps"
    first = run.record.keyframes[0]  # one keyframe has the depth of the scene
    take_in_frames(pipeline, FinishedMap({}, frames_of(run, [first]), {first}, {}, run.record.scene_depth))

    def keep(_: str, frame: TrackedFrame, render: NDArray[np.float32]) -> None:
        results.write_frame(frame, render)

    def frames() -> Iterator[TrackedFrame]:
        yield from frames_of(run, range(len(run)), line.prepare)

    again = line.through("evaluating the refined map", frames(), len(run))
    return evaluate(pipeline, again, {STAGE: version}, lpips, keep)
