"""The frames of a stream that have arrived and wait for the tracker, and even thinning where it is slower than they."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from math import floor
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

Item = TypeVar("Item")

# Frames that may wait: 20 s at 30 frames a second.
LIMIT = 600
# While the tracker is busy, so many frames in a row are not even decoded, as a share of its last stride.
UNDECODED = 0.25

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


@dataclass(frozen=True)
class Arrivals:
    """The frames that a source which follows a clock has received so far.

    Attributes:
        arrived: Number of frames.
        thinned: Number of frames that were left out evenly.
        newest: `time.monotonic()` when the newest frame was received [s]; 0 before the first.
    """

    arrived: int
    thinned: int
    newest: float

    def notes(self, source: Path) -> list[str]:
        """Return a remark on the frames of a source that were left out, if any."""
        if not self.thinned:
            return []
        return [
            f"{self.thinned} of {self.arrived} frames of {source} came faster than they could be tracked and were left "
            "out evenly"
        ]


class Backlog(Generic[Item]):
    """Queue of arrived frames, from which the tracker gets every n-th, as `Thinning` decides.

    More than `LIMIT` waiting frames are reduced to every second of them. The queue is not locked, and is told the time.

    Args:
        drop: Called for each frame that is left out.
    """

    def __init__(self, drop: Callable[[Item], None] | None = None) -> None:
        self._thinning = Thinning()
        self._drop = drop
        self._waiting: deque[tuple[float, Item | None]] = deque()
        self._arrived = self._thinned = 0
        self._newest = 0.0
        self._takes = 0
        self._taken = 0.0  # when the last frame was taken
        self._stride = 1
        self._undecoded = 0  # frames in a row
        self._to_skip: int | None = None  # frames to leave out before the next one; None until that is decided

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def arrivals(self) -> Arrivals:
        return Arrivals(self._arrived, self._thinned, self._newest)

    def wants(self) -> bool:
        """Whether the frame that arrives next may be tracked, so that it has to be decoded."""
        if self._to_skip is None:
            return self._undecoded >= int(UNDECODED * self._stride)
        return len(self._waiting) >= self._to_skip

    def add(self, time: float, item: Item | None) -> None:
        """Add a frame that arrived at `time` [s]. None for one that was not decoded, which is left out in its turn."""
        self._undecoded = self._undecoded + 1 if item is None else 0
        self._thinning.arrived(time)
        self._arrived, self._newest = self._arrived + 1, time
        self._waiting.append((time, item))
        if len(self._waiting) > LIMIT:
            frames = list(self._waiting)
            self._waiting = deque(frames[1::2])
            for _, left_out in frames[::2]:
                self._leave_out(left_out)

    def take(self, now: float) -> tuple[float, Item] | None:
        """Return the next frame to be tracked with its time of arrival, or None if it has not arrived.

        The time since the last frame was taken counts as the tracker's, except after the first frame, when the tracker
        is still being opened.

        Args:
            now: The time [s].
        """
        if self._to_skip is None:
            if self._takes > 1:
                self._thinning.tracked(now - self._taken)
            lag = max(0.0, now - self._waiting[0][0]) if self._waiting else 0.0
            self._stride = self._thinning.stride(lag)
            self._to_skip = self._stride - 1
        while self._waiting:
            arrived, item = self._waiting.popleft()
            if not self._to_skip and item is not None:
                self._takes, self._taken, self._to_skip = self._takes + 1, now, None
                return arrived, item
            self._leave_out(item)
            self._to_skip = max(0, self._to_skip - 1)
        return None

    def clear(self) -> None:
        """Remove all waiting frames, and count them as if they had not arrived."""
        count = len(self._waiting)
        self._arrived, self._thinned = self._arrived - count, self._thinned - count
        while self._waiting:
            self._leave_out(self._waiting.popleft()[1])

    def _leave_out(self, item: Item | None) -> None:
        self._thinned += 1
        if self._drop is not None and item is not None:
            self._drop(item)


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
