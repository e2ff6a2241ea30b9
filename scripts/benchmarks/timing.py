"""Timing of calls on Taichi's current device, and the memory of a process."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Sequence

import numpy as np

from fields.runtime.engine import ti

__all__ = ["milliseconds", "resident_mb", "seconds", "stage_milliseconds"]


def seconds(call: Callable[[], object], wait: Callable[[], object] = ti.sync) -> float:
    """Return the time of a call [s], with the device synchronised by `wait` before and after it."""
    wait()
    start = time.perf_counter()
    call()
    wait()
    return time.perf_counter() - start


def stage_milliseconds(stages: Sequence[tuple[str, Callable[[], object]]], repeats: int) -> dict[str, float]:
    """Return the median time of each stage [ms] over `repeats` passes through all stages, after one warm-up pass.

    The device is synchronised after every stage. On a GPU, the sum therefore exceeds the time of an undisturbed pass.
    """
    times: dict[str, list[float]] = {name: [] for name, _ in stages}
    for number in range(repeats + 1):
        for name, call in stages:
            taken = seconds(call)
            if number:
                times[name].append(taken)
    return {name: 1e3 * float(np.median(of)) for name, of in times.items()}


def milliseconds(call: Callable[[], object], repeats: int) -> float:
    """Return the median time of `repeats` calls [ms], after one warm-up call."""
    return stage_milliseconds([("call", call)], repeats)["call"]


def resident_mb() -> float:
    """Return the host memory of this process now [10^6 bytes], NaN on systems other than Linux."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * resource.getpagesize() / 1e6
    except OSError:
        return float("nan")
