"""Whole runs of scenes, online, as a user starts them."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments import Job, execute, named_scenes

__all__ = ["measure_runs", "planned_runs"]


def planned_runs(scenes: Sequence[str], device: str, settings: Mapping[str, str], folder: Path) -> list[Job]:
    """A run of every scene file, without refinement, into folders by the scenes' names in `folder`.

    settings: overrides by key. Raises InputError for scenes that cannot be run.
    """
    overrides = {"refine.steps": "0", "device": device, **settings}
    jobs = [
        Job(f"whole run of {name}", scene, folder / name, overrides) for name, scene in named_scenes(scenes).items()
    ]
    for job in jobs:
        job.check()
    return jobs


def measure_runs(scenes: Sequence[str], device: str, settings: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """Figures of metrics.json of the planned runs, by the scene's name. Raises InputError where one fails."""
    with tempfile.TemporaryDirectory() as folder:
        jobs = planned_runs(scenes, device, settings, Path(folder))
        results = execute(jobs)
    kept = ("frames", "keyframes", "gaussians", "frames_per_second", "peak_memory_mb", "seconds", "breakdown_percent")
    return {
        job.folder.name: {key: metrics[key] for key in kept} | {"psnr": metrics["online"]["held_out"]["psnr"]}
        for job, metrics in zip(jobs, results, strict=True)
    }
