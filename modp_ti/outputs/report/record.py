"""What a run notes for its report and stores in no other output file, and how its map keeps quality."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from modp_ti.outputs.evaluation import FrameScore, keyframe_psnr
from pipelines.pipeline import FrameReport, Pipeline

# Keyframes in a row over which the worst change is averaged.
WINDOW = 20


@dataclass(frozen=True, slots=True)
class FrameNote:
    """A processed frame.

    Attributes:
        index: The frame's index.
        held_out: Whether it was held out.
        is_keyframe: Whether it became a keyframe.
        done: Time since the first frame began [s].
        gaussians: Number of Gaussians after the frame.
        psnr: Mean PSNR of the last optimisation step's views [dB], None if nothing was optimised.
        mapped_psnr: PSNR of the keyframe itself after its own steps [dB], None for other frames.
        lag: In a realtime run, time from the frame's arrival to the map that holds it [s]; otherwise None.
        waiting: In a realtime run, number of frames that waited when its work began; otherwise None.
        steps: In a realtime run, number of optimisation steps that the frame got; otherwise 0.
    """

    index: int
    held_out: bool
    is_keyframe: bool
    done: float
    gaussians: int
    psnr: float | None
    mapped_psnr: float | None = None
    lag: float | None = None
    waiting: int | None = None
    steps: int = 0


@dataclass(frozen=True, slots=True)
class StepNote:
    """A step of refinement or offline optimisation.

    Attributes:
        step: Number of the step, from 1.
        psnr: Mean PSNR of its views [dB].
        gaussians: Number of Gaussians, None during refinement.
    """

    step: int
    psnr: float
    gaussians: int | None = None


@dataclass
class RunRecord:
    """Frames and steps of a run, in order.

    Attributes:
        clock: Returns seconds from an arbitrary origin.
        frames: The processed frames.
        steps: The finished steps.
        notes: One-line notes of the run, for example about skipped frames.
        device: Description of the backend.
        started: When the run began [s since 1970].
    """

    clock: Callable[[], float] = time.perf_counter
    frames: list[FrameNote] = field(default_factory=list)
    steps: list[StepNote] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    device: str = ""
    started: float = field(default_factory=time.time)
    _first: float = 0.0

    def begin(self) -> None:
        """Start the clock, before the first frame or before the next frame of a resumed run."""
        self._first = self.clock() - (self.frames[-1].done if self.frames else 0.0)

    def frame(
        self,
        index: int,
        report: FrameReport | None,
        mapped_psnr: float | None = None,
        lag: float | None = None,
        waiting: int | None = None,
    ) -> None:
        """Record a finished frame.

        Args:
            index: The frame's index.
            report: What the frame did to the map, None for a held-out frame.
            mapped_psnr: PSNR of a keyframe after its own steps [dB].
            lag: Time from its arrival to the map that holds it [s], in a realtime run.
            waiting: Number of frames that waited when its work began, in a realtime run.
        """
        done = self.clock() - self._first
        if report is None:
            before = self.frames[-1].gaussians if self.frames else 0
            note = FrameNote(index, True, False, done, before, None, None, lag, waiting)
        else:
            of = index, False, report.is_keyframe, done, report.gaussians, report.psnr
            note = FrameNote(*of, mapped_psnr, lag, waiting, 0 if lag is None else report.steps)
        self.frames.append(note)


def mapped_psnr(pipeline: Pipeline, report: FrameReport | None) -> float | None:
    """Return the PSNR [dB] of a keyframe that was just optimised. None for other frames.

    Args:
        pipeline: The map.
        report: What the last frame did to the map, None if it was held out.
    """
    if report is None or not report.is_keyframe or report.psnr is None:
        return None
    with pipeline.stopwatch.measure("evaluate"):
        return keyframe_psnr(pipeline, pipeline.keyframes.selected[-1])


def retention(frames: Sequence[FrameNote], scores: Sequence[FrameScore]) -> dict[str, Mapping[str, float]] | None:
    """Compare the PSNR of keyframes in each version of the map with that after their own optimisation steps.

    Args:
        frames: The run's frames, in order.
        scores: Scores of all frames in all versions.

    Returns:
        By version, the change of PSNR [dB], negative where quality was lost: `mean` over all keyframes, and `worst`,
        the least mean over any 20 keyframes in a row (over all of them if there are fewer). None without keyframes
        whose PSNR was measured.
    """
    mapped = {note.index: note.mapped_psnr for note in frames if note.mapped_psnr is not None}
    result: dict[str, Mapping[str, float]] = {}
    for stage in dict.fromkeys(score.stage for score in scores):
        final = {score.index: score.psnr for score in scores if score.stage == stage}
        change = np.array([final[index] - psnr for index, psnr in mapped.items() if index in final])
        if not len(change):  # none was measured, or none could be read again
            return None
        width = min(WINDOW, len(change))
        window = np.convolve(change, np.full(width, 1.0 / width), mode="valid")
        result[stage] = {"mean": round(float(change.mean()), 4), "worst": round(float(window.min()), 4)}
    return result if mapped else None
