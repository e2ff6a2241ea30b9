"""Features that are followed from image to image: Shi-Tomasi corners and pyramidal Lucas-Kanade flow."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["corners", "flow"]

WINDOW = (21, 21)
LEVELS = 4  # above the image itself
# A point that is followed there and back must come home this near [px].
ROUND_TRIP = 0.7
# Least eigenvalue of a corner's gradients, as a share of the best corner's: of the whole image, and of its cell alone.
QUALITY = 0.002
BORDER = 8  # px: nearer to the edge a window is cut off


def flow(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    pixels: NDArray[np.float64],
    guess: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Where pixels (N, 2) of the image before are in the one after, and which were followed there and back.

    Both images (H, W) uint8, pixel centres at +0.5. guess: (N, 2) where they are looked for first.
    """
    if len(pixels) == 0:
        return np.zeros((0, 2)), np.zeros(0, dtype=bool)
    height, width = before.shape
    before = _lit_alike(before, after)
    # cv2 counts pixel centres from 0 and wants float32.
    start = (pixels - 0.5).astype(np.float32)[:, None]
    there = np.clip(guess - 0.5, (-width, -height), (2 * width, 2 * height)).astype(np.float32)[:, None]
    options = {
        "winSize": WINDOW,
        "maxLevel": _levels(before),
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02),
    }
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, start, there.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **options
    )
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        after, before, there, start.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **options
    )
    found = (found[:, 0] > 0) & (returned[:, 0] > 0) & np.isfinite(there).all(axis=(1, 2))
    found &= np.linalg.norm(back - start, axis=(1, 2)) < ROUND_TRIP
    result = there[:, 0].astype(np.float64) + 0.5
    found &= (result >= BORDER).all(axis=1) & (result <= (width - BORDER, height - BORDER)).all(axis=1)
    return result, found


def _lit_alike(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image before in the light of the one after: flow takes a brightness that changes for motion."""
    (mean,), (deviation,) = (each.ravel() for each in cv2.meanStdDev(before))
    (mean_after,), (deviation_after,) = (each.ravel() for each in cv2.meanStdDev(after))
    gain = float(deviation_after / max(deviation, 1e-6))
    if not 0.5 < gain < 2.0 or (abs(gain - 1.0) < 0.02 and abs(mean - mean_after) < 2.0):
        return before
    return cv2.convertScaleAbs(before, alpha=gain, beta=float(mean_after - gain * mean))


def _levels(grey: NDArray[np.uint8]) -> int:
    """Levels above the image that leave room for a window."""
    levels = 0
    while levels < LEVELS and min(grey.shape) >> (levels + 1) > 2 * WINDOW[0]:
        levels += 1
    return levels


def corners(
    grey: NDArray[np.uint8],
    taken: NDArray[np.float64],
    wanted: int,
    valid: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """New corners (N, 2) of an image (H, W) uint8, centres at +0.5, on a grid, apart from those `taken` (M, 2).

    wanted: how many there should be together with those taken. valid: (H, W), False where none may be.
    """
    height, width = grey.shape
    if min(height, width) <= 4 * BORDER:
        return np.zeros((0, 2))
    cell = max(8, round(np.sqrt(width * height / max(wanted, 1))))
    rows, columns = -(-height // cell), -(-width // cell)
    response = cv2.cornerMinEigenVal(grey, 7, ksize=3)
    local = response >= cv2.dilate(response, np.ones((7, 7), np.uint8))
    usable = np.zeros((height, width), dtype=bool)
    usable[BORDER:-BORDER, BORDER:-BORDER] = True
    if valid is not None:
        # A window that reaches over the mask's edge follows the edge.
        usable &= cv2.erode(valid.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    if len(taken):
        blocked = np.zeros((height, width), np.uint8)
        for x, y in np.floor(taken).astype(int).tolist():
            cv2.circle(blocked, (x, y), max(5, cell // 3), 1, -1)
        usable &= blocked == 0
    y, x = np.nonzero(local & usable)
    strength = response[y, x]
    good = strength > max(QUALITY * float(response.max()), 1e-6)
    y, x, strength = y[good], x[good], strength[good]

    occupied = np.zeros(rows * columns, dtype=np.int64)
    if len(taken):
        c = np.clip(np.floor(taken[:, 1] / cell), 0, rows - 1) * columns
        c += np.clip(np.floor(taken[:, 0] / cell), 0, columns - 1)
        occupied += np.bincount(c.astype(np.int64), minlength=rows * columns)
    of_cell = (y // cell) * columns + x // cell
    order = np.lexsort((-strength, of_cell))
    of_cell, x, y, strength = of_cell[order], x[order], y[order], strength[order]
    first = np.searchsorted(of_cell, of_cell)
    rank = np.arange(len(of_cell)) - first + occupied[of_cell]
    # One a cell first; where cells stay empty, the others' next best take their place.
    order = np.lexsort((-strength, rank))
    chosen = order[: max(0, wanted - len(taken))]
    chosen = chosen[rank[chosen] < 3]
    return np.stack([x[chosen], y[chosen]], axis=1) + 0.5
