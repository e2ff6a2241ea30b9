"""Random walks for what drifts from frame to frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["smooth_walks"]


def smooth_walks(frames: int, count: int, drift: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """(frames, count) standard-normal values, each column correlated over `drift` frames; 0 for independent ones."""
    white = rng.standard_normal((frames, count))
    distance = np.arange(frames)[:, None] - np.arange(frames)[None, :]
    kernel = np.exp(-0.5 * (distance / max(drift, 1e-3)) ** 2)
    kernel /= np.linalg.norm(kernel, axis=1, keepdims=True)
    return kernel @ white
