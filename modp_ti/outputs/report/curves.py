"""Computes the numbers behind the report's curves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import camera_centres
from modp_ti.outputs.report.record import FrameNote

__all__ = ["binned", "frame_rate", "shifts_and_turns"]

# Maximum number of points of a curve. More would not be visible.
MOST_POINTS = 400


def frame_rate(frames: Sequence[FrameNote], window: int) -> NDArray[np.float64]:
    """Return frames per second (N,) over the `window` frames that end at each frame.

    The first `window - 1` values are NaN. If there are fewer frames than `window`, the last value is the rate over all
    of them.
    """
    done = np.array([0.0, *(note.done for note in frames)])
    window = min(window, len(frames))
    rate = np.full(len(frames), np.nan)
    rate[window - 1 :] = window / np.maximum(done[window:] - done[:-window], 1e-9)
    return rate


def binned(
    x: NDArray[np.float64], y: NDArray[np.float64], points: int = MOST_POINTS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Average neighbouring finite values into at most `points` bins, and return the means of x and y."""
    finite = np.isfinite(y)
    x, y = x[finite], y[finite]
    parts = max(1, min(points, len(x)))
    return (
        np.array([part.mean() for part in np.array_split(x, parts) if len(part)]),
        np.array([part.mean() for part in np.array_split(y, parts) if len(part)]),
    )


def shifts_and_turns(
    before: Sequence[NDArray[np.float64]], after: Sequence[NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far each camera moved [scene units] and turned [degrees].

    Args:
        before: T_camera_world (4, 4) of every frame.
        after: The same frames' poses after the change.
    """
    a, b = np.asarray(before), np.asarray(after)
    R_a, R_b = a[:, :3, :3], b[:, :3, :3]
    # |R - I|^2 = 8 sin^2(angle / 2): exact for small angles, where the arc cosine of the trace is not.
    difference = np.linalg.norm(R_b @ R_a.transpose(0, 2, 1) - np.eye(3), axis=(1, 2))
    turns = 2 * np.arcsin(np.minimum(difference / np.sqrt(8.0), 1.0))
    return np.linalg.norm(camera_centres(b) - camera_centres(a), axis=1), np.degrees(turns)
