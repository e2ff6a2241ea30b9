"""What may look on while a scene is mapped, between the steps of its session."""

from __future__ import annotations

from typing import Protocol

from fields.frames.tracked_frame import TrackedFrame
from modp_ti.engine.mapper import Mapper
from pipelines.pipeline import FrameReport

__all__ = ["Observer", "Unobserved"]


class Observer(Protocol):
    """Is called by the mapping thread, the only one that touches the map; it waits for the call to return.

    waited: seconds that calls have held the mapping because a person asked for it; no work of the mapper.
    """

    waited: float

    def begin(self, mapper: Mapper, frames: int | None) -> None:
        """The map, still empty, and how many frames will come, where that is known."""

    def on_frame(self, frame: TrackedFrame, report: FrameReport | None) -> None:
        """A frame has been taken in; None for one that is held out."""

    def on_step(self, stage: str, step: int, steps: int, psnr: float) -> None:
        """A step of refinement or of offline optimisation is done. psnr: mean of its views."""

    def on_stage(self, stage: str) -> None:
        """The map is finished, and something else goes on with it: it must not be touched any more."""


class Unobserved:
    """Nobody looks on."""

    waited = 0.0

    def begin(self, mapper: Mapper, frames: int | None) -> None: ...

    def on_frame(self, frame: TrackedFrame, report: FrameReport | None) -> None: ...

    def on_step(self, stage: str, step: int, steps: int, psnr: float) -> None: ...

    def on_stage(self, stage: str) -> None: ...
