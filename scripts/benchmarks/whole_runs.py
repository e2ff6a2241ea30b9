"""Measures whole online runs of scenes, started as a user starts them."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments import Job, execute, named_scenes

__all__ = ["measure_runs", "planned_runs"]


def planned_runs(scenes: Sequence[str], device: str, settings: Mapping[str, str], folder: Path) -> list[Job]:
    """Return a job for every scene file, without refinement, with output folders named after the scenes.

    Args:
        scenes: Scene files.
        device: "cpu" or "cuda".
        settings: Overrides by key.
        folder: Parent of the output folders.

    Raises:
        InputError: If a scene cannot be run.
    """
    overrides = {"refine.steps": "0", "device": device, **settings}
    jobs = [
        Job(f"whole run of {name}", scene, folder / name, overrides) for name, scene in named_scenes(scenes).items()
    ]
    for job in jobs:
        job.check()
    return jobs


def measure_runs(scenes: Sequence[str], device: str, settings: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """Run the scenes and return their figures of metrics.json by the scene's name. Raises InputError if a run fails."""
    with tempfile.TemporaryDirectory() as folder:
        jobs = planned_runs(scenes, device, settings, Path(folder))
        results = execute(jobs)
    kept = ("frames", "keyframes", "gaussians", "frames_per_second", "peak_memory_mb", "seconds", "breakdown_percent")
    return {
        job.folder.name: {key: metrics[key] for key in kept} | {"psnr": metrics["online"]["held_out"]["psnr"]}
        for job, metrics in zip(jobs, results, strict=True)
    }
