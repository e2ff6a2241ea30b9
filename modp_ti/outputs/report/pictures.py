"""Comparisons of frames and renders with their difference, small enough to embed in a page."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.outputs.evaluation import FrameScore
from modp_ti.outputs.playback.map_renderer import eight_bits

__all__ = ["FULL_SCALE", "Album", "Comparison", "as_uri", "data_uri", "error_colours", "error_map", "picked"]

# Error at which the colour scale ends.
FULL_SCALE = 0.2
# Number of frames shown, and how many of them are the worst ones. The others are spread evenly over the ranks up to the
# best.
SHOWN = 7
WORST = 3
# Longer side of a picture in the page [px], and its JPEG quality.
LONGEST = 480
QUALITY = 85


@dataclass(frozen=True)
class Comparison:
    """A frame, the render from its pose, and their difference, each as a data URI.

    Attributes:
        score: The frame's score in the map shown.
        rank: "worst", "median", "best" or empty.
        frame: The frame's image.
        render: The render.
        error: The error map.
    """

    score: FrameScore
    rank: str
    frame: str
    render: str
    error: str


@dataclass
class Album:
    """Keeps 8-bit copies of the frames and renders that a report may show.

    Attributes:
        wanted: Indices of the frames to keep.
        kept: Image and render by index.
    """

    wanted: frozenset[int]
    kept: dict[int, tuple[NDArray[np.uint8], NDArray[np.uint8]]] = field(default_factory=dict)

    @classmethod
    def of(cls, held_out: Sequence[bool]) -> Album:
        """Create an album for a run.

        With held-out frames it keeps nothing, as their pictures are in the `renders` folder. Otherwise it keeps a few
        frames.

        Args:
            held_out: Whether each frame is held out.
        """
        if any(held_out):
            return cls(frozenset())
        return cls(frozenset(np.linspace(0, len(held_out) - 1, min(SHOWN, len(held_out))).round().astype(int).tolist()))

    def keep(self, index: int, image: NDArray[np.float32], render: NDArray[np.float32]) -> None:
        """Store the image and render (H, W, 3), in [0, 1], if the frame is wanted."""
        if index in self.wanted:
            self.kept[index] = eight_bits(image), eight_bits(render)

    def comparisons(self, scores: Iterable[FrameScore], renders: Path) -> list[Comparison]:
        """Return the comparisons of the page, worst first.

        Args:
            scores: Scores of one map version.
            renders: Folder with the pictures of the held-out frames.
        """
        scores = list(scores)
        held_out = [score for score in scores if score.held_out]
        comparisons = []
        for score, rank in picked(held_out or [score for score in scores if score.index in self.kept]):
            image, render = self.kept.get(score.index) or _read_pair(renders / f"{score.index:06d}.png")
            error = error_colours(error_map(image, render))
            comparisons.append(Comparison(score, rank, data_uri(image), data_uri(render), data_uri(error)))
        return comparisons


def picked(scores: Sequence[FrameScore]) -> list[tuple[FrameScore, str]]:
    """Choose at most SHOWN scores: the worst ones, then evenly spaced ranks up to the best.

    Returns:
        The scores with their rank in words, which may be empty.
    """
    order = sorted(scores, key=lambda score: (score.psnr, score.index))
    last = len(order) - 1
    places = list(range(min(WORST, len(order))))
    if last >= WORST:
        places += np.linspace(WORST - 1, last, SHOWN - WORST + 1).round().astype(int)[1:].tolist()
        if last >= SHOWN - 1:
            places[WORST] = last // 2
    words = {last // 2: "median", last: "best", 0: "worst"} if last > 1 else {}
    return [(order[place], words.get(place, "")) for place in sorted(set(places))]


def error_map(image: NDArray[np.uint8], render: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the mean absolute difference (H, W) of two pictures (H, W, 3), scaled to [0, 1]."""
    return (np.abs(image.astype(np.float32) - render.astype(np.float32)).mean(axis=2) / 255.0).astype(np.float32)


def error_colours(error: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Map errors (H, W) to RGB colours (H, W, 3), from black for 0 to pale yellow for FULL_SCALE and more."""
    steps = np.round(np.clip(error / FULL_SCALE, 0.0, 1.0) * 255.0).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(steps, cv2.COLORMAP_INFERNO), dtype=np.uint8)[..., ::-1]


def data_uri(picture: NDArray[np.uint8], longest: int = LONGEST) -> str:
    """Encode a picture (H, W, 3) RGB as a JPEG data URI, scaled down to sides of at most `longest` pixels."""
    height, width = picture.shape[:2]
    factor = min(1.0, longest / max(height, width))
    if factor < 1.0:
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), options)
    return as_uri("jpeg", data.tobytes())


def as_uri(kind: str, data: bytes) -> str:
    """Return an image file of this kind as a data URI."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def _read_pair(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Split a side-by-side picture into frame and render."""
    pair = cv2.imread(str(path))
    if pair is None:
        raise InputError(f"{path}: the picture is missing or damaged; run again to write it")
    pair = np.asarray(pair, dtype=np.uint8)[..., ::-1]
    half = pair.shape[1] // 2
    return pair[:, :half], pair[:, half:]
