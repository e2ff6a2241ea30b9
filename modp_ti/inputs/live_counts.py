"""`LiveCounts`: what a tracker that follows a clock has done so far."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["LiveCounts"]


@dataclass(frozen=True)
class LiveCounts:
    """What a tracker that follows a clock has done so far.

    Attributes:
        arrived: Number of frames received.
        tracked: Number of frames that were given a pose.
        thinned: Number of frames that were left out evenly before tracking.
        lost: Number of frames that the tracker could not place.
        waiting: Number of frames that wait for the mapper now.
        newest: `time.monotonic()` when the newest frame was received [s].
    """

    arrived: int
    tracked: int
    thinned: int
    lost: int
    waiting: int
    newest: float
