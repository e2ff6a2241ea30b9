"""The threads of Taichi's CPU backend, each kept on a processor of its own."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["pin_workers", "threads_of_process"]

TASKS = Path("/proc/self/task")


def threads_of_process() -> set[int]:
    """Numbers of this process's threads; empty where the system does not tell."""
    return {int(task.name) for task in TASKS.iterdir()} if TASKS.is_dir() else set()


def pin_workers(before: set[int], workers: int) -> None:
    """Keep each of Taichi's workers on its own processor, where it has as many workers as there are processors.

    before: the threads that there were before Taichi started. Its workers sleep between kernels, and Linux wakes two of
    them on one processor again and again: a kernel of 1 ms then takes two threads as long as one, a step a quarter
    longer. With fewer workers than processors they go where there is room.
    """
    if not hasattr(os, "sched_setaffinity"):
        return
    processors = sorted(os.sched_getaffinity(0))
    if workers != len(processors):
        return
    # Its compiling threads are older than its workers.
    for thread, processor in zip(sorted(threads_of_process() - before)[-workers:], processors, strict=False):
        os.sched_setaffinity(thread, {processor})
