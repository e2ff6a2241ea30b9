"""The cores of this process, and the scheduling of parallel CPU loops.

Taichi 1.7.4 assigns the iterations of a parallel CPU loop to threads in chunks of 512, whatever `block_dim` says, so
that a shorter loop runs on one thread. A loop over n heavy tasks is therefore written as

    for i in range(n * SPREAD):
        if i % SPREAD == 0:
            self._task(i // SPREAD)

with SPREAD = HANDED_OUT // (number of tasks per chunk). The empty iterations cost less than a nanosecond each.
"""

import os

HANDED_OUT = 512


def available_cores() -> int:
    """Return the number of cores on which this process may run."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
