"""Timing calls on whichever device Taichi runs, and the memory that a process has taken."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Sequence

import numpy as np
import taichi as ti

__all__ = ["milliseconds", "peak_memory_mb", "stage_milliseconds"]


def stage_milliseconds(stages: Sequence[tuple[str, Callable[[], object]]], repeats: int) -> dict[str, float]:
    """Median of each stage, of `repeats` passes through all of them in their order after one that does not count.

    The device is waited for after every stage, so that their sum exceeds a pass that is left to itself on a GPU.
    """
    times: dict[str, list[float]] = {name: [] for name, _ in stages}
    for number in range(repeats + 1):
        for name, call in stages:
            ti.sync()
            start = time.perf_counter()
            call()
            ti.sync()
            if number:
                times[name].append(time.perf_counter() - start)
    return {name: 1e3 * float(np.median(of)) for name, of in times.items()}


def milliseconds(call: Callable[[], object], repeats: int) -> float:
    """Median of `repeats` calls after one that does not count."""
    return stage_milliseconds([("call", call)], repeats)["call"]


def peak_memory_mb() -> float:
    """The most memory of the host that this process has held, as of now."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
