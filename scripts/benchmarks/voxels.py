"""Measures the occupancy voxels with 300,000 random points on the walls of a room 80 coarsest cells wide."""

from __future__ import annotations

import numpy as np

from benchmarks.timing import resident_mb, seconds
from fields.runtime.backend import initialise
from fields.voxels.occupancy import OccupancyVoxels

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
    before = resident_mb()
    for batch in points:
        times["query"].append(seconds(lambda batch=batch: voxels.query(batch, size)))
        times["update"].append(seconds(lambda batch=batch: voxels.update(batch, size)))
    megabytes = resident_mb() - before
    voxels = compiled()
    for batch in points:
        times["admit"].append(seconds(lambda batch=batch: voxels.admit(batch, size)))
    return {name: 1e3 * float(np.median(of)) for name, of in times.items()} | {"megabytes": megabytes}
