"""The occupancy voxels of the GPU, sparse or hashed, give the answers of the CPU's and are saved alike."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fields.voxels.occupancy import OccupancyVoxels

LEVELS = 9


def answers() -> list[NDArray]:
    """All answers to questions about 12,000 bricks, which do not fit into the first hash table, and the marks."""
    voxels = OccupancyVoxels(1.0, LEVELS, resolution=64)
    rng = np.random.default_rng(5)
    found = []
    for _ in range(4):
        # Near and far from the origin, some beyond the range of the finest levels, and many close to another.
        points = rng.normal(size=(3000, 3)) * 10 ** rng.uniform(-1, 4.5, (3000, 1))
        points[1500:] = points[:1500] + rng.normal(size=(1500, 3)) * 10 ** rng.uniform(-3, 0, (1500, 1))
        sizes = np.sort(2.0 ** -rng.integers(0, LEVELS, 3000))[::-1]
        found += [voxels.query(points, sizes), voxels.bytes_to_mark(points, sizes), voxels.admit(points, sizes)]
        voxels.rest(points[::7])
        found.append(np.array(voxels.nbytes))
    return [*found, *voxels.marks()]


def test_answers_and_marks_are_those_of_the_cpu(on_both: Callable) -> None:
    cpu, gpu = on_both(answers)
    assert 0.1 < cpu[-5].mean() < 0.9  # neither none nor all of the last batch is admitted
    for ours, theirs in zip(cpu, gpu, strict=True):
        np.testing.assert_array_equal(theirs, ours)


def test_marks_of_one_device_are_restored_on_the_other(on_both: Callable) -> None:
    rng = np.random.default_rng(6)
    first, second = rng.uniform(-3, 3, (2, 400, 3))
    saved: list[tuple[NDArray, ...]] = []

    def resumed() -> tuple[NDArray, ...]:
        voxels = OccupancyVoxels(1.0, LEVELS, resolution=64)
        if saved:
            voxels.restore(*saved[0])
        else:
            voxels.update(first, 0.01)
            saved.append(voxels.marks())
        voxels.update(second, 0.1)
        return voxels.marks()

    for ours, theirs in zip(*on_both(resumed), strict=True):
        np.testing.assert_array_equal(theirs, ours)
