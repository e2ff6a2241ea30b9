"""Frames with the features that are tracked through them: Shi-Tomasi corners and pyramidal Lucas-Kanade flow."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.multiview.features import (
    FLOW_WINDOW,
    Features,
    detect_features,
    flow_there_and_back,
    match_anywhere,
)

WANTED = 450  # features that are tracked
DESCRIBED_SIDE = 400  # longer side at which SIFT features are detected: 60 % of the time that 640 px take
LEVELS = 4  # pyramid levels above the image itself, at most
# Levels above the image, forwards and backwards, where the predicted motion is at most SLOW px in the median. The way
# back starts where it should end. All levels are used if a smaller share of the points than PREDICTED_SHARE is tracked.
SLOW = 12.0
SLOW_LEVELS, RETURN_LEVELS = 2, 1
PREDICTED_SHARE = 0.85
FEWEST_MATCHES, MATCH_ERROR = 15, 8.0  # matches that fit a homography, and their error [px]
# Largest forward-backward error [px].
ROUND_TRIP = 0.7
# Smallest minimum eigenvalue of a corner's structure tensor, as a share of the best corner's.
QUALITY = 0.002
BORDER = 8  # px from the edge, where windows would be cut off
# Bands of rows and strips of columns whose brightness is compared. The bands are lit apart if the logarithm of their
# change deviates by UNEVEN between them, and by twice as much as between the strips.
BANDS, STRIPS = 60, 4
UNEVEN = 0.04


@dataclass
class Frame:
    """A grey image and its features.

    Attributes:
        number: Number of the frame, increasing.
        grey: (H, W) uint8.
        valid: (H, W), False where no features may be tracked; None for everywhere.
        ids: (N,) ids of its features.
        pixels: (N, 2) their positions.
        features: Its SIFT features; None until they are needed.
    """

    number: int
    grey: NDArray[np.uint8]
    valid: NDArray[np.bool_] | None = None
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    pixels: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    features: Features | None = None

    @property
    def described(self) -> Features:
        """Its SIFT features, detected when they are first needed."""
        if self.features is None:
            colour = np.repeat(self.grey[..., None], 3, axis=2)
            self.features = detect_features(colour, side=DESCRIBED_SIDE)
        return self.features

    def track(self, other: Frame, guess: NDArray[np.float64] | None = None) -> None:
        """Replace the features by those of another frame that optical flow finds in this one.

        Args:
            other: A frame with N features.
            guess: (N, 2) their expected positions in this frame; those in `other` by default.
        """
        pixels, found = flow(other.grey, self.grey, other.pixels, guess)
        self.ids, self.pixels = other.ids[found], pixels[found]

    def track_by_matches(self, other: Frame) -> None:
        """As `track`, from where the homography that fits most SIFT matches expects the features; none without one."""
        a, b = other.described, self.described
        pairs = match_anywhere(a, b)
        self.ids, self.pixels = self.ids[:0], self.pixels[:0]
        if len(pairs) < FEWEST_MATCHES or len(other.pixels) == 0:
            return
        found, fits = cv2.findHomography(a.pixels[pairs[:, 0]], b.pixels[pairs[:, 1]], cv2.RANSAC, MATCH_ERROR)
        if found is not None and fits.sum() >= FEWEST_MATCHES:
            self.track(other, np.asarray(cv2.perspectiveTransform(other.pixels[:, None], found)[:, 0], np.float64))

    def append(self, ids: NDArray[np.int64], pixels: NDArray[np.float64]) -> None:
        """Add features (M,) at pixels (M, 2), except those that the frame already has."""
        fresh = ~np.isin(ids, self.ids)
        self.ids = np.concatenate([self.ids, ids[fresh]])
        self.pixels = np.concatenate([self.pixels, pixels[fresh]])

    def new_corners(self) -> NDArray[np.float64]:
        """Corners (M, 2) away from the features, with which the frame has WANTED features."""
        return corners(self.grey, self.pixels, WANTED, self.valid)


@dataclass
class LocalisedFrame(Frame):
    """A frame with a pose.

    Attributes:
        T_camera_world: (4, 4).
    """

    T_camera_world: NDArray[np.float64] = field(kw_only=True)


def flow(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    pixels: NDArray[np.float64],
    guess: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Track points from one image to the next, with a forward-backward check.

    Pixel centres are at +0.5.

    Args:
        before: (H, W) uint8.
        after: (H, W) uint8.
        pixels: (N, 2) points in `before`.
        guess: (N, 2) predicted positions in `after`, None to start from `pixels`. Few pyramid levels are enough where a
            slow motion is predicted, unless that turns out to be wrong.

    Returns:
        Positions (N, 2) in `after`, and a mask (N,) of the points that were tracked.
    """
    if len(pixels) == 0:
        return np.zeros((0, 2)), np.zeros(0, dtype=bool)
    before = _lit_alike(before, after)
    levels = _levels(before)
    if guess is not None and levels > SLOW_LEVELS and np.median(np.linalg.norm(guess - pixels, axis=1)) <= SLOW:
        result, found = _flow(before, after, pixels, guess, SLOW_LEVELS, RETURN_LEVELS)
        if found.mean() >= PREDICTED_SHARE:
            return result, found
    return _flow(before, after, pixels, pixels if guess is None else guess, levels, levels)


def _flow(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    pixels: NDArray[np.float64],
    guess: NDArray[np.float64],
    levels: int,
    return_levels: int,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Track points with the image and `levels` pyramid levels above it, on the way back `return_levels`; see `flow`."""
    height, width = before.shape
    # In cv2 the first pixel's centre is 0, and points are float32.
    start = (pixels - 0.5).astype(np.float32)[:, None]
    there = np.clip(guess - 0.5, (-width, -height), (2 * width, 2 * height)).astype(np.float32)[:, None]
    there, off = flow_there_and_back(before, after, start, there, levels, return_levels)
    result = there[:, 0].astype(np.float64) + 0.5
    inside = (result >= BORDER).all(axis=1) & (result <= (width - BORDER, height - BORDER)).all(axis=1)
    return result, (off < ROUND_TRIP) & inside


def _lit_alike(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Match brightness and contrast of `before` to `after`, since flow mistakes exposure changes for motion.

    Where the contrast changes by a factor of two or more, the histogram is matched.
    """
    gains = _gains_of_rows(before, after)
    if gains is not None:
        return np.clip(np.rint(before * gains[:, None]), 0, 255).astype(np.uint8)
    (mean,), (deviation,) = (each.ravel() for each in cv2.meanStdDev(before))
    (mean_after,), (deviation_after,) = (each.ravel() for each in cv2.meanStdDev(after))
    gain = float(deviation_after / max(deviation, 1e-6))
    if abs(gain - 1.0) < 0.02 and abs(mean - mean_after) < 2.0:
        return before
    if not 0.5 < gain < 2.0:  # values may be cut off at black or white
        rank, rank_after = (np.cumsum(np.bincount(each.ravel(), minlength=256)) for each in (before, after))
        levels = np.clip(np.searchsorted(rank_after, rank), 0, 255).astype(np.uint8)
        return np.asarray(cv2.LUT(before, levels), dtype=np.uint8)
    return np.asarray(cv2.convertScaleAbs(before, alpha=gain, beta=float(mean_after - gain * mean)), dtype=np.uint8)


def _gains_of_rows(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> NDArray[np.float32] | None:
    """Factors (H,) from the brightness of each row of `before` to that of `after`; None if no bands are lit apart.

    Lamps that flicker with the mains, and a sensor that exposes its rows one after the other, give bands that wander
    over the image. A scene that moves changes the brightness of rows too, but not alike in all columns.
    """
    then, now = (
        np.log1p(cv2.resize(each, (STRIPS, BANDS), interpolation=cv2.INTER_AREA).astype(np.float32))
        for each in (before, after)
    )
    change = cv2.blur(now - then, (1, 3))
    common = np.median(change, axis=1)
    if np.std(common) < max(UNEVEN, 2.0 * float(np.std(change - common[:, None]))):
        return None
    return np.exp(cv2.resize(common[:, None], (1, before.shape[0]), interpolation=cv2.INTER_LINEAR)[:, 0])


def _levels(grey: NDArray[np.uint8]) -> int:
    """Number of pyramid levels above the image whose shorter side still exceeds two windows."""
    levels = 0
    while levels < LEVELS and min(grey.shape) >> (levels + 1) > 2 * FLOW_WINDOW[0]:
        levels += 1
    return levels


def corners(
    grey: NDArray[np.uint8],
    taken: NDArray[np.float64],
    wanted: int,
    valid: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """Detect new corners, distributed over a grid and away from existing features.

    Args:
        grey: (H, W) uint8.
        taken: (M, 2) existing features.
        wanted: Number of features, including `taken`.
        valid: (H, W), False where no corner may be.

    Returns:
        Corners (N, 2), with pixel centres at +0.5.
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
        # A window across the mask's edge would track the edge.
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
    # First the best corner of each cell, then the next best ones where cells have none.
    order = np.lexsort((-strength, rank))
    chosen = order[: max(0, wanted - len(taken))]
    chosen = chosen[rank[chosen] < 3]
    return np.stack([x[chosen], y[chosen]], axis=1).astype(np.float64) + 0.5
