"""One run: frames from the tracker through the mapper to the files of the output folder."""

from __future__ import annotations

import json
import os
import resource
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from fields.backend import describe, initialise
from fields.camera import PinholeCamera
from fields.tracked_frame import TrackedFrame
from modp_ti.config import SceneConfig, dump_scene
from modp_ti.errors import InputError
from modp_ti.evaluation import FrameScore, MapVersion, evaluate, summary, trajectory_errors
from modp_ti.exports.colmap_model import image_names, write_colmap, write_image
from modp_ti.exports.exposure import write_exposures
from modp_ti.exports.scores_csv import write_scores
from modp_ti.exports.splats_ply import read_splats, write_splats
from modp_ti.exports.trajectory import write_trajectory
from modp_ti.lpips import open_lpips
from modp_ti.prefetch import FramesAhead
from modp_ti.progress import ProgressLine
from modp_ti.tracked_points import TrackedPoints
from modp_ti.trackers import close, frame_count, may_read_ahead, open_tracker
from pipelines.mapping import OnlineMapper
from pipelines.offline import OfflineMapper
from pipelines.refinement import refine
from pipelines.stopwatch import breakdown_percent

__all__ = ["build_mapper", "run_scene"]

STAGES = ("compile", "read", "track", "select", "depth", "occupancy", "optimise", "refine", "evaluate")
# Versions of a map that metrics.json has room for; null where a run does not make one.
MAPS = ("online", "refined", "offline")


@dataclass
class Poses:
    """What is kept of every frame: its name, time, camera and pose, and the points that it saw."""

    name: list[str] = field(default_factory=list)
    camera: list[PinholeCamera] = field(default_factory=list)
    points: TrackedPoints = field(default_factory=TrackedPoints)
    index: list[int] = field(default_factory=list)
    timestamp: list[float] = field(default_factory=list)
    tracked: list[NDArray[np.float64]] = field(default_factory=list)

    def add(self, frame: TrackedFrame) -> None:
        self.name.append(frame.name)
        self.camera.append(frame.camera)
        self.points.add(frame)
        self.index.append(frame.index)
        self.timestamp.append(frame.timestamp)
        self.tracked.append(frame.T_camera_world)


def run_scene(config: SceneConfig, console: Console | None = None) -> Path:
    """Map the scene of `config` and write its output folder, which is returned.

    Nothing is written before the map is finished; the files then appear together. Raises InputError for input that
    cannot be used.
    """
    with ExitStack() as held:
        return _run(config, console or Console(quiet=True), held)


def _run(config: SceneConfig, console: Console, held: ExitStack) -> Path:
    """`run_scene`; held: takes what is to be closed at its end, however it ends."""
    started = time.perf_counter()
    line = ProgressLine(console)
    try:
        backend = initialise(config.device, config.threads, config.seed)
    except RuntimeError as error:
        raise InputError(str(error)) from None
    console.print(f"device: {describe(backend)}", highlight=False, soft_wrap=True)
    tick = time.perf_counter()
    tracker = open_tracker(config, line.prepare)
    held.callback(close, tracker)
    ahead = config.source.prefetch if may_read_ahead(tracker) else 0
    with FramesAhead(tracker, ahead) as frames:
        first = next(frames, None)
        if first is None:
            raise InputError("the tracker delivered no frame: nothing to map")
        prepared = time.perf_counter() - tick
        lpips, no_lpips = open_lpips(config.evaluation.lpips_weights, min(first.camera.width, first.camera.height))
        notes = [*tracker.notes, *([no_lpips] if no_lpips else [])]
        _say(notes, console)

        mapper = build_mapper(config, first.camera)
        watch = mapper.stopwatch
        watch.seconds["track"] = prepared
        with line.working("compiling kernels (the first time on this machine takes longest)"):
            mapper.compile()
        tick = time.perf_counter()
        line.start_mapping(frame_count(tracker), "reading" if config.mode == "offline" else "mapping")
        poses = _map(mapper, chain([first], _timed(frames, watch)), line)
        mapping_seconds = time.perf_counter() - tick
    _say([note for note in tracker.notes if note not in notes], console)
    breakdown = breakdown_percent(watch.seconds, mapping_seconds)
    if len(mapper.keyframes) == 0:
        raise InputError(
            f"no frame became a keyframe: none has {config.mapping.keyframes.min_points} tracked points; "
            "give a tracker with points or lower mapping.keyframes.min_points"
        )
    versions = {config.mode: _version(mapper, poses)}
    if config.refine.steps and isinstance(mapper, OnlineMapper):
        line.start_refining(config.refine.steps)
        refine(mapper, config.refine, line.refined)
        line.stop()
        versions["refined"] = _version(mapper, poses)
    last = list(versions)[-1]
    final = versions[last]

    staging = config.output.with_name(config.output.name + ".partial")
    shutil.rmtree(staging, ignore_errors=True)
    try:
        (staging / "renders").mkdir(parents=True)
        write_splats(staging / "splats.ply", final.gaussians)
        write_trajectory(staging / "trajectory.txt", poses.timestamp, final.trajectory)
        names = image_names(poses.name, config.export.images)
        write_colmap(staging / "colmap", names, poses.camera, final.trajectory, poses.points)
        if mapper.keyframes[0].exposure is not None:
            keyframes = {k.index for k in mapper.keyframes}
            write_exposures(staging / "exposure.json", poses.index, poses.timestamp, final.exposures, keyframes)
        # What is scored is what a reader of the file gets.
        versions[last] = replace(final, gaussians=read_splats(staging / "splats.ply"))

        def keep(stage: str, frame: TrackedFrame, render: NDArray[np.float32]) -> None:
            if stage == last and config.export.images:
                write_image(staging / "colmap", names[frame.index], frame)
            if stage == last and frame.held_out:
                _write_pair(staging / "renders" / f"{frame.index:06d}.png", frame.image, render)

        with watch.measure("evaluate"), line.working("evaluating the saved map"):
            with FramesAhead(tracker, ahead) as again:
                scores = evaluate(mapper, again, versions, lpips, keep)
        write_scores(staging / "scores.csv", scores)
        metrics = {
            "frames": len(poses.index),
            "keyframes": len(mapper.keyframes),
            "gaussians": len(mapper.gaussians),
            "backend": backend,
            "seed": config.seed,
            "frames_per_second": round(len(poses.index) / mapping_seconds, 4),
            "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
            **{stage: _summary(scores, stage, versions[stage]) if stage in versions else None for stage in MAPS},
            "lpips_note": no_lpips,
            "seconds": _seconds(watch.seconds, time.perf_counter() - started),
            "breakdown_percent": breakdown,
            **trajectory_errors(poses.tracked, final.trajectory, getattr(tracker, "ground_truth", list)()),
            "reprojection_error": _rounded(poses.points.reprojection_error(poses.camera, final.trajectory)),
            "reprojection_error_tracked": _rounded(poses.points.reprojection_error(poses.camera, poses.tracked)),
        }
        (staging / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
        dump_scene(config, staging / "config.yaml")
        _publish(staging, config.output)
    except OSError as error:
        raise InputError(f"{config.output}: cannot be written: {error.strerror}") from None
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    line.summary(metrics)
    return config.output


def _say(notes: Iterable[str], console: Console) -> None:
    for note in notes:
        console.print(f"note: {note}", highlight=False, soft_wrap=True)


def build_mapper(config: SceneConfig, camera: PinholeCamera) -> OnlineMapper | OfflineMapper:
    """The mapper of the scene's mode, for images of this camera. Raises InputError where its settings do not fit."""
    try:
        if config.mode == "offline":
            return OfflineMapper(config.offline, camera.width, camera.height, config.seed)
        return OnlineMapper(config.mapping, camera.width, camera.height, config.seed)
    except ValueError as error:
        raise InputError(str(error)) from None


def _map(mapper: OnlineMapper | OfflineMapper, frames: Iterable[TrackedFrame], line: ProgressLine) -> Poses:
    """Take all frames in, and finish the map; their poses."""
    poses, size = Poses(), None
    try:
        for frame in frames:
            size = size or (frame.camera.width, frame.camera.height)
            if (frame.camera.width, frame.camera.height) != size:
                raise InputError(
                    f"{frame.name} is {frame.camera.width}x{frame.camera.height}, the first frame {size[0]}x{size[1]}: "
                    "all images of a scene must have one size"
                )
            poses.add(frame)
            line.frame(None if frame.held_out else mapper.process(frame))
        if isinstance(mapper, OfflineMapper):
            _optimise_offline(mapper, line)
        else:
            mapper.finish()
    finally:
        line.stop()
    return poses


def _version(mapper: OnlineMapper | OfflineMapper, poses: Poses) -> MapVersion:
    """The map as it stands."""
    store = mapper.keyframes
    return MapVersion(
        mapper.gaussians.to_numpy(),
        [store.corrected(i, T) for i, T in zip(poses.index, poses.tracked, strict=True)],
        [store.exposure_at(i) for i in poses.index],
        mapper.renderer.view_renders,
    )


def _optimise_offline(mapper: OfflineMapper, line: ProgressLine) -> None:
    try:
        mapper.initialise()
    except ValueError as error:
        raise InputError(f"`mode: offline` starts from tracked points: {error}") from None
    line.start_offline(mapper.settings.steps)
    mapper.optimise(line.optimised)


def _timed(frames: Iterator[TrackedFrame], watch) -> Iterator[TrackedFrame]:
    """The frames, the time that the mapper waits for each counted as reading."""
    while True:
        with watch.measure("read"):
            frame = next(frames, None)
        if frame is None:
            return
        yield frame


def _summary(scores: list[FrameScore], stage: str, version: MapVersion) -> dict[str, dict | int]:
    """A version's means over all frames and over those held out, and what it took."""
    of = [score for score in scores if score.stage == stage]
    return {
        "all": summary(of),
        "held_out": summary([score for score in of if score.held_out]),
        "gaussians": len(version.gaussians["position"]),
        "view_renders": version.view_renders,
    }


def _write_pair(path: Path, image: NDArray[np.float32], render: NDArray[np.float32]) -> None:
    """A PNG with the frame on the left and the render on the right."""
    pair = np.hstack([image, render])
    cv2.imwrite(str(path), np.round(pair[..., ::-1] * 255.0).astype(np.uint8))


def _seconds(stages: dict[str, float], total: float) -> dict[str, float]:
    """Seconds of each stage of metrics.json, and what is left of the total."""
    seconds = {"total": round(total, 3)}
    seconds |= {stage: round(stages.get(stage, 0.0), 3) for stage in STAGES}
    seconds["other"] = round(total - sum(stages.get(stage, 0.0) for stage in STAGES), 3)
    return seconds


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


def _publish(staging: Path, output: Path) -> None:
    """Move the finished files into the output folder, over those of an earlier run."""
    output.mkdir(parents=True, exist_ok=True)
    for folder in ("renders", "colmap"):
        shutil.rmtree(output / folder, ignore_errors=True)
    for item in staging.iterdir():
        os.replace(item, output / item.name)
