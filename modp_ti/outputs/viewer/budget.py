"""`CostLimit`: keeps what the viewer costs below a share of the mapper's time, by measuring it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["CostLimit", "ThreadClock"]

# Seconds of mapping whose share can be saved up while nothing is shown.
SAVED_UP = 60.0


class CostLimit:
    """An account in seconds: `share` of the mapping time comes in, what the viewer costs goes out.

    Something may be done while there is anything in it, and may overdraw it; nothing more is then done until mapping
    has paid for it. So the cost stays below `share` of the time, but for the last thing done.
    """

    def __init__(self, share: float, clock: Callable[[], float] = time.perf_counter) -> None:
        self.share = share
        self.cost = 0.0
        self._clock = clock
        self._balance = 0.0
        self._seen = clock()

    def allows(self) -> bool:
        """Whether something may be done now."""
        self._earn()
        return self._balance > 0.0

    def charge(self, seconds: float) -> None:
        """Something has cost this much."""
        self.cost += seconds
        self._balance -= seconds

    @contextmanager
    def measured(self) -> Iterator[None]:
        """Charge for the block, by the clock."""
        started = self._clock()
        try:
            yield
        finally:
            self.charge(self._clock() - started)

    @contextmanager
    def suspended(self) -> Iterator[None]:
        """Nothing comes in during the block: the mapper is held."""
        self._earn()
        try:
            yield
        finally:
            self._seen = self._clock()

    def _earn(self) -> None:
        now = self._clock()
        self._balance = min(self._balance + self.share * (now - self._seen), self.share * SAVED_UP)
        self._seen = now


class ThreadClock:
    """Processor time [s] that threads have taken since it was asked last. They must be alive at first.

    Where the system does not tell (it does on Linux), always 0.
    """

    def __init__(self, threads: list[threading.Thread]) -> None:
        clock_of = getattr(time, "pthread_getcpuclockid", None)
        clocks = [] if clock_of is None else [clock_of(thread.ident) for thread in threads]
        self._last = {clock: time.clock_gettime(clock) for clock in clocks}

    def since_last(self) -> float:
        taken = 0.0
        for clock, before in list(self._last.items()):
            try:
                self._last[clock] = time.clock_gettime(clock)
            except OSError:  # the thread has ended
                del self._last[clock]
            else:
                taken += self._last[clock] - before
        return taken
