"""`CostLimit`: measures the viewer's cost and keeps it below a share of the mapper's time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["CostLimit", "ThreadClock"]

# Mapping time [s] whose share can be saved up while nothing is shown.
SAVED_UP = 60.0


class CostLimit:
    """A time budget that earns `share` of the elapsed time and pays for the viewer's work.

    Work may start while the balance is positive, and may overdraw it. The next work then waits until the balance is
    positive again. The total cost therefore exceeds `share` of the time by at most the last piece of work.

    Args:
        share: Fraction of the mapping time that the viewer may cost.
        clock: Returns the time [s].

    Attributes:
        cost: Total cost so far [s].
    """

    def __init__(self, share: float, clock: Callable[[], float] = time.perf_counter) -> None:
        self.share = share
        self.cost = 0.0
        self._clock = clock
        self._balance = 0.0
        self._seen = clock()

    def allows(self) -> bool:
        """Return whether work may start now."""
        self._earn()
        return self._balance > 0.0

    def charge(self, seconds: float) -> None:
        """Subtract a cost [s] from the balance."""
        self.cost += seconds
        self._balance -= seconds

    @contextmanager
    def measured(self) -> Iterator[None]:
        """Charge the wall time of this context."""
        started = self._clock()
        try:
            yield
        finally:
            self.charge(self._clock() - started)

    @contextmanager
    def suspended(self) -> Iterator[None]:
        """Earn nothing inside this context, since the mapper is paused."""
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
    """CPU time [s] that a set of threads has taken since the last query.

    The threads must be alive when the clock is created. On systems without per-thread CPU clocks, the result is always
    0.
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
