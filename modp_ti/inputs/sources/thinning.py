"""Even thinning of a stream of images that is faster than its tracker."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from math import floor

import numpy as np

__all__ = ["Thinning"]

# Lag [s] below which a short stretch of expensive frames thins nothing: strides follow the mean of COSTS frames.
CALM_LAG = 0.4
# Time [s] within which the tracker should have worked off the frames that wait for it.
HORIZON = 4.0
# Largest time between two tracked frames [s], as long as the tracker can keep that up and the lag is below LONGEST_LAG.
LARGEST_GAP = 0.15
LONGEST_LAG = 4.0
# For a tracker that is too slow for that, the lag from which strides grow beyond what its costs demand.
LONG_LAG = 1.0
# The tracker gets this much more time than it takes on average, because its costs vary.
ROOM = 1.05
# Numbers of intervals between frames, and of tracked frames, over which the means are taken.
INTERVALS, COSTS, RECENT_COSTS = 256, 128, 32
# Nothing is thinned before so many frames were tracked.
FEWEST_COSTS = 6
# A value counts at most this multiple of the mean: one pause of the stream or the tracker hardly changes the rates.
CLIP = 5.0


class Thinning:
    """Policy that decides which frames of a stream are tracked.

    The mean stride is the smallest with which the tracker keeps up and works off the waiting frames within `HORIZON`.
    It need not be whole: with 2.5, every second and every third frame are tracked in turn. It is 1 for a tracker that
    keeps up: the frames that wait absorb short pauses.

    A larger stride makes the tracker's frames more expensive, because keyframes come at the same times as before. To
    work off waiting frames, strides therefore grow no further than to `LARGEST_GAP`, unless the tracker cannot keep
    that up or the lag is longer than `LONGEST_LAG`.

    The policy is told times, and never reads a clock.
    """

    def __init__(self) -> None:
        self._newest: float | None = None
        self._intervals: deque[float] = deque(maxlen=INTERVALS)
        self._costs: deque[float] = deque(maxlen=COSTS)
        self._rest = 0.0  # by which the strides so far are smaller than their means

    def arrived(self, time: float) -> None:
        """Take note that a frame has arrived at `time` [s]."""
        if self._newest is not None:
            self._intervals.append(time - self._newest)
        self._newest = time

    def tracked(self, seconds: float) -> None:
        """Take note that the tracker took `seconds` for a frame."""
        self._costs.append(seconds)

    def load(self, costs: int = RECENT_COSTS) -> float:
        """Time that the tracker takes for a frame, divided by the interval between frames; 0 while it is unknown.

        Args:
            costs: Number of the last tracked frames over which the mean is taken.
        """
        if len(self._costs) < FEWEST_COSTS or not self._intervals:
            return 0.0
        return _usual(list(self._costs)[-costs:]) / self._interval

    @property
    def _interval(self) -> float:
        return max(_usual(self._intervals), 1e-6)

    def stride(self, lag: float) -> int:
        """Decide on the next frame: the n-th after the last one.

        Args:
            lag: Age of the oldest waiting frame [s]; 0 if none waits.
        """
        needed = ROOM * self.load(COSTS)
        load = needed if lag < CALM_LAG else ROOM * self.load()
        if load == 0.0:
            return 1
        # The share of the tracker's time that is left for new frames while the waiting ones are worked off.
        share = max(1.0 - lag / HORIZON, 1.0 / HORIZON)
        largest = max(1.0, floor(LARGEST_GAP / self._interval))
        most = max(needed, largest) * min(max(lag / (LONG_LAG if needed > largest else LONGEST_LAG), 1.0), 2.0)
        self._rest += max(1.0, min(load / share, most))
        stride = floor(self._rest)
        self._rest -= stride
        return stride


def _usual(values: Collection[float]) -> float:
    """Mean of the values, each of them at most about `CLIP` times that mean."""
    array = np.array(list(values))
    mean = array.mean()
    for _ in range(3):
        mean = np.minimum(array, CLIP * mean).mean()
    return float(mean)
