"""`likeness`: how well a render resembles a picture, whatever its exposure."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["likeness"]

# Standard deviations [px] of the blurs between which structures count: coarser than the detail that a map lacks, finer
# than light and shade.
FINE, COARSE = 1.5, 8.0
MIN_PIXELS = 1000


def likeness(render: NDArray[np.floating], image: NDArray[np.floating], valid: NDArray[np.bool_]) -> float:
    """Correlation of a band of the grey render and the grey image.

    Args:
        render: Rendered colour (H, W, 3).
        image: Observed colour (H, W, 3).
        valid: Pixels that count (H, W).

    Returns:
        From -1 to 1; 0 if fewer than 1000 pixels count, or one of them has no structure.
    """
    if np.count_nonzero(valid) < MIN_PIXELS:
        return 0.0
    a, b = (_band(picture, valid)[valid] for picture in (render, image))
    length = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / length if length > 0 else 0.0


def _band(picture: NDArray[np.floating], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The band (H, W) of the mean of the colours. Other pixels do not enter the blur."""
    weight = valid.astype(np.float64)
    grey = picture.astype(np.float64).mean(axis=2) * weight

    def blurred(sigma: float) -> NDArray[np.float64]:
        share = np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-6)
        return np.asarray(cv2.GaussianBlur(grey, (0, 0), sigma) / share)

    return blurred(FINE) - blurred(COARSE)
