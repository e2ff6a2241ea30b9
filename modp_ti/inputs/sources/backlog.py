"""The frames of a stream that have arrived and wait for the tracker."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from modp_ti.inputs.sources.thinning import Thinning

__all__ = ["LIMIT", "Arrivals", "Backlog"]

Item = TypeVar("Item")

# Frames that may wait: 20 s at 30 frames a second.
LIMIT = 600
# While the tracker is busy, so many frames in a row are not even decoded, as a share of its last stride.
UNDECODED = 0.25


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
        self._arrived -= len(self._waiting)
        while self._waiting:
            _, item = self._waiting.popleft()
            if self._drop is not None and item is not None:
                self._drop(item)

    def _leave_out(self, item: Item | None) -> None:
        self._thinned += 1
        if self._drop is not None and item is not None:
            self._drop(item)
