"""`retention`: how a map keeps the quality that keyframes had soon after they were mapped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from modp_ti.outputs.evaluation import FrameScore, keyframe_psnr
from modp_ti.outputs.report.record import FrameNote
from pipelines.pipeline import FrameReport, Pipeline

__all__ = ["WINDOW", "mapped_psnr", "retention"]

# Keyframes in a row over which the worst change is averaged.
WINDOW = 20


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
    if not mapped:
        return None
    result: dict[str, Mapping[str, float]] = {}
    for stage in dict.fromkeys(score.stage for score in scores):
        final = {score.index: score.psnr for score in scores if score.stage == stage}
        change = np.array([final[index] - psnr for index, psnr in mapped.items() if index in final])
        if not len(change):  # no keyframe could be read again
            return None
        width = min(WINDOW, len(change))
        window = np.convolve(change, np.full(width, 1.0 / width), mode="valid")
        result[stage] = {"mean": round(float(change.mean()), 4), "worst": round(float(window.min()), 4)}
    return result
