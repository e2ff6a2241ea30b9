"""Thread affinity of Taichi's CPU backend."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["pin_workers", "threads_of_process"]

TASKS = Path("/proc/self/task")


def threads_of_process() -> set[int]:
    """Ids of this process's threads; empty on systems without /proc."""
    return {int(task.name) for task in TASKS.iterdir()} if TASKS.is_dir() else set()


def pin_workers(before: set[int], workers: int) -> None:
    """Pin each of Taichi's workers to its own processor, if there are as many workers as processors.

    The workers sleep between kernels, and Linux often wakes two of them on the same processor. A kernel of 1 ms then
    takes as long on two threads as on one, and a step takes a quarter longer. With fewer workers than processors, the
    scheduler has free processors to choose from.

    Args:
        before: Ids of the threads that existed before Taichi started.
        workers: Number of Taichi's worker threads.
    """
    if not hasattr(os, "sched_setaffinity"):
        return
    processors = sorted(os.sched_getaffinity(0))
    if workers != len(processors):
        return
    # Taichi starts its compiler threads before its workers, so the workers have the highest ids.
    for thread, processor in zip(sorted(threads_of_process() - before)[-workers:], processors, strict=False):
        os.sched_setaffinity(thread, {processor})
