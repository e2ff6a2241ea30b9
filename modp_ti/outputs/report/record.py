"""`RunRecord`: what is noted while a run goes on, and no other of its files holds."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipelines.pipeline import FrameReport

__all__ = ["FrameNote", "RunRecord", "StepNote"]


@dataclass(frozen=True, slots=True)
class FrameNote:
    """A frame that was taken in. done: seconds since the first began. gaussians: in the map when it was done.

    psnr: of the views of its last optimisation step [dB], None where nothing was optimised.
    """

    index: int
    held_out: bool
    is_keyframe: bool
    done: float
    gaussians: int
    psnr: float | None


@dataclass(frozen=True, slots=True)
class StepNote:
    """A step of refinement or of offline optimisation. psnr: mean of its views [dB]. gaussians: where it says."""

    step: int
    psnr: float
    gaussians: int | None = None


@dataclass
class RunRecord:
    """Frames and steps in their order.

    notes: one-line remarks that the run made, such as frames that were skipped. device: what it said of the backend
    that it took. clock: seconds from any beginning. started: of the calendar, seconds since 1970.
    """

    clock: Callable[[], float] = time.perf_counter
    frames: list[FrameNote] = field(default_factory=list)
    steps: list[StepNote] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    device: str = ""
    started: float = field(default_factory=time.time)
    _first: float = 0.0

    def begin(self) -> None:
        """The first frame is about to be taken in, or the next one of a resumed run."""
        self._first = self.clock() - (self.frames[-1].done if self.frames else 0.0)

    def frame(self, index: int, report: FrameReport | None) -> None:
        """Note a frame that is done; report: None for one that is held out."""
        done = self.clock() - self._first
        if report is None:
            before = self.frames[-1].gaussians if self.frames else 0
            self.frames.append(FrameNote(index, True, False, done, before, None))
        else:
            self.frames.append(FrameNote(index, False, report.is_keyframe, done, report.gaussians, report.psnr))

    def refined(self, step: int, psnr: float) -> None:
        """Note a step of post refinement; steps count from 1."""
        self.steps.append(StepNote(step, psnr))

    def optimised(self, step: int, gaussians: int, psnr: float) -> None:
        """Note a step of offline optimisation; steps count from 1."""
        self.steps.append(StepNote(step, psnr, gaussians))
