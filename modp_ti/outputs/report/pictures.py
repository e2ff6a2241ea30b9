"""Frames beside the map and where they differ, small enough to be put into a page."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from modp_ti.outputs.evaluation import FrameScore

__all__ = ["FULL_SCALE", "Album", "Comparison", "data_uri", "error_colours", "error_map", "picked"]

# Error that has the last colour of the error maps.
FULL_SCALE = 0.2
# Frames that are shown, and of these the worst ones; the others are spread over the ranks up to the best.
SHOWN = 7
WORST = 3
# Longer side of a picture in the page [px], and its JPEG quality.
LONGEST = 480
QUALITY = 85


@dataclass(frozen=True)
class Comparison:
    """A frame, the map from its place, and their difference, each as the address of a picture within the page.

    rank: "worst", "median", "best" or empty. score: of the map that is shown.
    """

    score: FrameScore
    rank: str
    frame: str
    render: str
    error: str


@dataclass
class Album:
    """Keeps the pictures that a report may need of an evaluation: of `wanted` frames, by index, as 8 bits."""

    wanted: frozenset[int]
    kept: dict[int, tuple[NDArray[np.uint8], NDArray[np.uint8]]] = field(default_factory=dict)

    @classmethod
    def of(cls, held_out: Sequence[bool]) -> Album:
        """For frames of which those held out are in the folder of pictures anyhow; for others it keeps a few."""
        if any(held_out):
            return cls(frozenset())
        return cls(frozenset(np.linspace(0, len(held_out) - 1, min(SHOWN, len(held_out))).round().astype(int).tolist()))

    def keep(self, index: int, image: NDArray[np.float32], render: NDArray[np.float32]) -> None:
        """Keep frame and render (H, W, 3) in [0, 1] where they are wanted."""
        if index in self.wanted:
            image, render = (np.round(np.clip(p, 0, 1) * 255).astype(np.uint8) for p in (image, render))
            self.kept[index] = image, render

    def comparisons(self, scores: Iterable[FrameScore], renders: Path) -> list[Comparison]:
        """What the page shows, the worst first, by the scores of one map. renders: folder of the held-out pairs."""
        scores = list(scores)
        held_out = [score for score in scores if score.held_out]
        chosen = picked(held_out or [score for score in scores if score.index in self.kept])
        return [
            _comparison(score, rank, *(self.kept.get(score.index) or _read_pair(renders / f"{score.index:06d}.png")))
            for score, rank in chosen
        ]


def picked(scores: Sequence[FrameScore]) -> list[tuple[FrameScore, str]]:
    """At most SHOWN scores with words for their ranks: the worst ones, then at equal steps to the best."""
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
    """Difference (H, W) of two pictures (H, W, 3): mean of its size over the three colours, 1 from black to white."""
    return (np.abs(image.astype(np.float32) - render.astype(np.float32)).mean(axis=2) / 255.0).astype(np.float32)


def error_colours(error: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colours (H, W, 3), RGB, of errors (H, W): from black for none to pale yellow for FULL_SCALE and more."""
    steps = np.round(np.clip(error / FULL_SCALE, 0.0, 1.0) * 255.0).astype(np.uint8)
    return cv2.applyColorMap(steps, cv2.COLORMAP_INFERNO)[..., ::-1]


def data_uri(picture: NDArray[np.uint8], longest: int = LONGEST) -> str:
    """A picture (H, W, 3), RGB, as the address of a JPEG that it holds itself, its sides at most `longest` pixels."""
    height, width = picture.shape[:2]
    factor = min(1.0, longest / max(height, width))
    if factor < 1.0:
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), options)
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def _comparison(score: FrameScore, rank: str, image: NDArray[np.uint8], render: NDArray[np.uint8]) -> Comparison:
    error = error_colours(error_map(image, render))
    return Comparison(score, rank, *(data_uri(picture) for picture in (image, render, error)))


def _read_pair(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Frame and render of a picture that shows them side by side."""
    pair = cv2.imread(str(path))[..., ::-1]
    half = pair.shape[1] // 2
    return pair[:, :half], pair[:, half:]
