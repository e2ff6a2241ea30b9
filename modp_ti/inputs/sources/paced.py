"""`Pace`: a recording is played at the pace of its time stamps."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from threading import Event

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.sources.backlog import Arrivals, Backlog


class Pace:
    """The arrival of a recording's images at the times of their time stamps, the first one at once.

    The clock starts when `arriving` is first asked for an image. Images that arrive faster than they are taken are left
    out evenly, see `Backlog`. If `arriving` is called again, it begins with the same images, without waiting; all calls
    must select the same images.

    Args:
        clock: Monotonic clock [s].
        wait: Waits so many seconds; None to wait until `finish` is called at most.
    """

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, wait: Callable[[float], object] | None = None
    ) -> None:
        self._clock = clock
        self._finished = Event()
        self._wait = self._finished.wait if wait is None else wait
        self._backlog: Backlog[str] = Backlog()
        self._due: NDArray[np.float64] | None = None  # of all selected images, once the clock has started
        self._come = 0  # number of them that have arrived
        self._order: list[str] = []  # the delivered images
        self._received: dict[str, float] = {}  # their times of arrival [s]

    def arriving(self, names: Sequence[str], times: Sequence[float]) -> Iterator[str]:
        """Yield images of these names and times [s] as they arrive."""
        position = 0
        while position < len(self._order) or self._next(names, times):
            yield self._order[position]
            position += 1

    def _next(self, names: Sequence[str], times: Sequence[float]) -> bool:
        """Wait for the next image to be tracked and append it to the order. Returns whether there is one."""
        if self._due is None:
            self._due = self._clock() + np.maximum.accumulate(np.subtract(times, times[0]))
        while True:
            now = self._clock()
            while self._come < len(names) and self._due[self._come] <= now and not self._finished.is_set():
                self._backlog.add(float(self._due[self._come]), names[self._come])
                self._come += 1
            taken = self._backlog.take(now)
            if taken is not None:
                self._received[taken[1]] = taken[0]
                self._order.append(taken[1])
                return True
            if self._come == len(names) or self._finished.is_set():
                return False
            self._wait(float(self._due[self._come]) - now)

    @property
    def recording(self) -> bool:
        """As of `ImageSource`."""
        more = self._due is None or self._come < len(self._due)
        return more and not self._finished.is_set()

    @property
    def arrivals(self) -> Arrivals:
        """Number of images received so far."""
        return self._backlog.arrivals

    def arrived(self, name: str) -> float | None:
        """As of `ImageSource`."""
        return self._received.get(name)

    def finish(self) -> None:
        """Let no more images arrive."""
        self._finished.set()

    def notes(self, source: Path) -> list[str]:
        """Return remarks on a source of this pace."""
        return [f"{source} is played at the pace of its time stamps", *self.arrivals.notes(source)]
