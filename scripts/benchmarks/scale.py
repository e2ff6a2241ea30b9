"""Measures a map of many copies of a recording side by side: quality, time and memory as the map grows."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.timing import resident_mb
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.runtime.backend import initialise
from modp_ti.config.scene_file import load_scene
from modp_ti.engine.build import build_mapper
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.run_clock import peak_memory_mb
from modp_ti.inputs.trackers import open_tracker
from modp_ti.outputs.evaluation import evaluate

__all__ = ["measure_world"]

# Distance of neighbouring copies [scene depths of the recording], and copies in a row. The rows lie in a plane across
# the mean viewing direction: where a copy saw others through the gaps of its own map, it lost up to 2 dB, because the
# recording does not show them.
DISTANCE = 5.0
ROW = 8


def measure_world(scene: str, copies: int, settings: list[str], folder: str) -> dict[str, Any]:
    """Map copies of a recording in one world, and return figures of each copy.

    Args:
        scene: Scene file. Its tracker must deliver all frames again when it is asked again.
        copies: Number of copies, in rows on a plane.
        settings: Overrides as key=value.
        folder: Folder for the parts of the map that go to disk.

    Returns:
        `copies`: for each copy, the time per frame [s], the Gaussians of the map so far, resident and on disk, and the
        memory after it [MB]; the held-out PSNR in the finished map [dB]; and figures of the finished map.
    """
    config = load_scene(Path(scene), [*settings, f"output={folder}"])
    initialise(config.device, config.mapper_threads, config.seed)
    tracker = open_tracker(config)
    first = next(iter(tracker))
    depths = [float(np.median(frame.points.depths(frame.T_camera_world))) for frame in tracker if len(frame.points)]
    steps = DISTANCE * float(np.median(depths)) * _across(tracker)
    mapper = build_mapper(config, first.camera)
    rows = []
    for copy in range(copies):
        began, count = time.process_time(), 0
        for frame in _copied(tracker, copy, steps):
            mapper.add(frame)
            count += 1
        paging = mapper.pipeline.paging  # pyright: ignore[reportAttributeAccessIssue]  # an online map has one
        rows.append(
            {
                "seconds_per_frame": (time.process_time() - began) / count,
                "gaussians": paging.count,
                "resident": len(mapper.pipeline.gaussians),
                "blocks_on_disk": len(paging.away),
                "resident_mb": resident_mb(),
            }
        )
        print(f"copy {copy + 1} of {copies}: {rows[-1]}", file=sys.stderr, flush=True)
    began = time.process_time()
    mapper.finish()
    finishing = time.process_time() - began
    psnr = _held_out(mapper, tracker, copies, steps)
    for row, of in zip(rows, psnr, strict=True):
        row["psnr"] = of
    return {
        "copies": rows,
        "frames": len(mapper.frames),
        "finishing_seconds": finishing,
        "gaussians": mapper.pipeline.gaussian_count,
        "peak_memory_mb": peak_memory_mb(),
        "guards": mapper.pipeline.caught().counts(),
    }


def _across(frames: Iterable[TrackedFrame]) -> NDArray[np.float64]:
    """Return two unit vectors (2, 3) that are orthogonal to each other and to the mean viewing direction."""
    direction = np.mean([frame.T_camera_world[2, :3] for frame in frames], axis=0)
    return np.linalg.svd(direction[None])[2][1:]


def _copied(frames: Any, copy: int, steps: NDArray[np.float64]) -> Iterator[TrackedFrame]:
    """Yield the frames of a recording, moved to the place of a copy by steps (2, 3) along and between the rows."""
    shift = np.array([copy % ROW, copy // ROW]) @ steps
    for frame in frames:
        T = frame.T_camera_world.copy()
        T[:3, 3] -= T[:3, :3] @ shift
        points = SparsePoints(frame.points.xyz + shift, frame.points.pixels, frame.points.ids + copy * 10_000_000)
        index = copy * 100_000 + frame.index
        yield replace(
            frame, index=index, timestamp=float(index), name=f"{copy}/{frame.name}", T_camera_world=T, points=points
        )


def _held_out(mapper: Mapper, tracker: Any, copies: int, steps: NDArray[np.float64]) -> list[float]:
    """Return the mean PSNR of each copy's held-out frames in the finished map [dB]."""
    version = mapper.version()
    place = {index: number for number, index in enumerate(mapper.frames.index)}
    means = []
    for copy in range(copies):
        frames = [replace(f, index=place[f.index]) for f in _copied(tracker, copy, steps) if f.held_out]
        scores = evaluate(mapper.pipeline, frames, {"online": version}, None, lambda *_: None)
        means.append(float(np.mean([score.psnr for score in scores])))
    return means
