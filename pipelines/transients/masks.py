"""Masks of what moves, from cell-wise decisions."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_SHARE", "soft_mask"]

# Smallest thing that is masked, and largest share of the image that all of them may take [of the image's cells]. More
# than that is a wrong pose or a map that is not good enough yet.
MIN_SHARE, MAX_SHARE = 0.005, 0.6
# Diameter of the neighbourhood in which most cells must agree, and of the margin around a mask [cells].
NEIGHBOURHOOD, MARGIN = 5, 5
# Standard deviation of the soft edge [cells].
EDGE = 1.0


def soft_mask(
    certain: NDArray[np.bool_], likely: NDArray[np.bool_], before: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8] | None:
    """Make a smooth mask with hysteresis from cell-wise decisions.

    A connected region of likely cells is masked if it contains certain cells, or cells that were masked before.

    Args:
        certain: Cells (h, w) that certainly show something that moves.
        likely: Cells (h, w) that probably do; contains `certain`.
        before: The earlier mask, as returned; None for none.

    Returns:
        Weights (h, w) uint8, 0 on what moves and 255 elsewhere, with a soft edge outside; None if nothing moves.
    """
    agreed = _most(likely)
    start = _most(certain)
    if before is not None:
        start |= before == 0
    label = np.asarray(cv2.connectedComponents(agreed.astype(np.uint8), connectivity=8)[1], dtype=np.int64)
    area = np.bincount(label.ravel())
    started = np.bincount(label.ravel(), weights=start.ravel()) > 0
    chosen = started & (area >= MIN_SHARE * label.size)
    chosen[0] = False
    masked = chosen[label]
    if not masked.any():
        return None
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (MARGIN, MARGIN))
    core = cv2.dilate(cv2.morphologyEx(masked.astype(np.uint8), cv2.MORPH_CLOSE, kernel), kernel)
    if core.mean() > MAX_SHARE:
        return None
    soft = cv2.GaussianBlur(core.astype(np.float32), (0, 0), EDGE)
    return np.where(core > 0, 0, np.rint(255 * np.clip(1.0 - 2.0 * soft, 0.0, 1.0))).astype(np.uint8)


def _most(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether more than half of the neighbourhood of each cell (h, w) is set."""
    share = cv2.blur(cells.astype(np.float32), (NEIGHBOURHOOD, NEIGHBOURHOOD), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(share) > 0.5
