"""`retention`: how a map keeps the quality that keyframes had soon after they were mapped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from modp_ti.outputs.evaluation import FrameScore
from modp_ti.outputs.report.record import FrameNote

__all__ = ["WINDOW", "retention"]

# Keyframes in a row over which the worst change is averaged.
WINDOW = 20


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
        change = np.array([final[index] - psnr for index, psnr in mapped.items()])
        width = min(WINDOW, len(change))
        window = np.convolve(change, np.full(width, 1.0 / width), mode="valid")
        result[stage] = {"mean": round(float(change.mean()), 4), "worst": round(float(window.min()), 4)}
    return result
