"""Measures the occupancy voxels with 300,000 random points on the walls of a room 80 coarsest cells wide."""

from __future__ import annotations

import os

import numpy as np

from benchmarks.timing import seconds
from fields.map.occupancy import OccupancyVoxels
from fields.runtime.backend import initialise

__all__ = ["LEVELS", "measure_voxels"]

POINTS, BATCHES, ROOM = 100_000, 3, 80.0
LEVELS = (3, 7)


def measure_voxels(device: str, threads: int, level: int) -> dict[str, float]:
    """Return milliseconds per 100,000 points at a level of the voxels, and the megabytes for 300,000 points."""
    initialise(device, threads)
    rng = np.random.default_rng(0)
    points = rng.uniform(-ROOM / 2, ROOM / 2, (BATCHES, POINTS, 3))
    wall = rng.integers(0, 6, points.shape[:2])
    np.put_along_axis(points, (wall // 2)[..., None], ((wall % 2) - 0.5)[..., None] * ROOM, axis=2)
    size = 0.5**level
    times: dict[str, list[float]] = {"query": [], "update": [], "admit": []}

    def compiled() -> OccupancyVoxels:
        voxels = OccupancyVoxels()
        voxels.query(np.zeros((0, 3)), size)
        voxels.admit(np.zeros((0, 3)), size)
        return voxels

    voxels = compiled()
    before = _resident_mb()
    for batch in points:
        times["query"].append(seconds(lambda batch=batch: voxels.query(batch, size)))
        times["update"].append(seconds(lambda batch=batch: voxels.update(batch, size)))
    megabytes = _resident_mb() - before
    voxels = compiled()
    for batch in points:
        times["admit"].append(seconds(lambda batch=batch: voxels.admit(batch, size)))
    return {name: 1e3 * float(np.median(of)) for name, of in times.items()} | {"megabytes": megabytes}


def _resident_mb() -> float:
    """Return the current resident memory of this process [MB], NaN on systems other than Linux."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        return float("nan")
