"""`TimeLeft`: estimate of the time that a stage still takes, from its recent pace."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

__all__ = ["TimeLeft", "duration"]

# Time that a stage must have run before an estimate is made [s].
EARLIEST = 10.0
# Share of the elapsed time whose items set the pace. Keyframes become slower as the map grows.
RECENT = 1 / 3


class TimeLeft:
    """Estimates the remaining time of a stage whose items take different times.

    The pace is that of the items finished in the last third of the elapsed time, since a keyframe takes longer the
    larger the map is. No estimate is made in the first ten seconds, or if the number of items is unknown.

    Args:
        total: Number of items; None if unknown.
        done: Number of items that are done already.
        clock: Returns the time [s].
    """

    def __init__(self, total: int | None, done: int = 0, *, clock: Callable[[], float]) -> None:
        self.total = total
        self._clock = clock
        self._began = clock()
        self._done = done
        # Times and counts, oldest first. The first one is the latest that lies before the recent third.
        self._history: deque[tuple[float, int]] = deque([(self._began, done)])

    def update(self, done: int) -> None:
        """Set the number of items that are done."""
        now = self._clock()
        self._done = done
        self._history.append((now, done))
        since = now - RECENT * (now - self._began)
        while len(self._history) > 2 and self._history[1][0] <= since:
            self._history.popleft()

    def seconds(self) -> float | None:
        """Return the estimated time until the last item is done [s], None if it is not known yet."""
        now = self._clock()
        then, before = self._history[0]
        if self.total is None or now - self._began < EARLIEST or self._done <= before:
            return None
        return (self.total - self._done) * (now - then) / (self._done - before)


def duration(seconds: float) -> str:
    """Return a duration as a person would say it: "40 s", "3 min" or "1 h 20 min"."""
    if seconds < 59.5:
        return f"{round(seconds)} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
