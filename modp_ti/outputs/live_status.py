"""`LiveStatus`: the figures of a realtime run that the progress line and the viewer show."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["LiveStatus"]


@dataclass(frozen=True)
class LiveStatus:
    """The recent figures of a realtime run.

    Attributes:
        camera: Frames per second that arrive.
        tracked: Frames per second that get a pose.
        lag: Time from the last mapped frame's arrival to the map that holds it [s].
        waiting: Number of frames that wait for the mapper.
        steps: Mean number of optimisation steps of the last keyframes.
    """

    camera: float
    tracked: float
    lag: float
    waiting: int
    steps: float

    def text(self) -> str:
        """Return the figures in one line."""
        return (
            f"lag {self.lag:.1f} s, {self.waiting} waiting, camera {self.camera:.1f}/s, tracked {self.tracked:.1f}/s, "
            f"{self.steps:.1f} steps a keyframe"
        )
