"""Even thinning of a stream of images that is faster than its tracker."""

from __future__ import annotations

from collections import deque
from math import ceil

import numpy as np

__all__ = ["Thinning"]

# Time [s] within which the tracker should have worked off the frames that wait for it.
HORIZON = 4.0
# The stride is reduced only if the smaller one would leave the tracker this much idle time.
ROOM = 1.1
# Numbers of intervals between frames, and of tracked frames, over which the means are taken.
INTERVALS, COSTS = 256, 32
# Nothing is thinned before so many frames were tracked.
FEWEST_COSTS = 6
# A value counts at most this multiple of the mean: one pause of the stream or the tracker hardly changes the rates.
CLIP = 5.0


class Thinning:
    """Policy that decides that every n-th frame of a stream is tracked.

    The stride n is the smallest that lets the tracker keep up on average and work off the waiting frames within
    `HORIZON`. It is 1 for a tracker that keeps up: short pauses are absorbed by the frames that wait. It changes by
    at most one at a time, and is at most twice the stride at which the tracker just keeps up.

    The policy is told times, and never reads a clock.
    """

    def __init__(self) -> None:
        self._newest: float | None = None
        self._intervals: deque[float] = deque(maxlen=INTERVALS)
        self._costs: deque[float] = deque(maxlen=COSTS)
        self._stride = 1

    def arrived(self, time: float) -> None:
        """Take note that a frame has arrived at `time` [s]."""
        if self._newest is not None:
            self._intervals.append(time - self._newest)
        self._newest = time

    def tracked(self, seconds: float) -> None:
        """Take note that the tracker took `seconds` for a frame."""
        self._costs.append(seconds)

    @property
    def load(self) -> float:
        """Time that the tracker takes for a frame, divided by the interval between frames; 0 while it is unknown."""
        if len(self._costs) < FEWEST_COSTS or not self._intervals:
            return 0.0
        return _usual(self._costs) / max(_usual(self._intervals), 1e-6)

    def stride(self, lag: float) -> int:
        """Decide on the next frame: the n-th after the last one.

        Args:
            lag: Age of the oldest waiting frame [s]; 0 if none waits.
        """
        load = self.load
        most = 2 * max(1, ceil(load))
        # The share of the tracker's time that is left for new frames while the waiting ones are worked off.
        share = max(1.0 - lag / HORIZON, 1.0 / HORIZON)
        if min(most, ceil(load / share)) > self._stride:
            self._stride += 1
        elif self._stride > 1 and min(most, ceil(ROOM * load / share)) < self._stride:
            self._stride -= 1
        return self._stride


def _usual(values: deque[float]) -> float:
    """Mean of the values, each of them at most about `CLIP` times that mean."""
    array = np.array(values)
    mean = array.mean()
    for _ in range(3):
        mean = np.minimum(array, CLIP * mean).mean()
    return float(mean)
