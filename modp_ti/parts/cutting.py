"""Cutting a recording into overlapping parts, in time and by what its frames see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from fields.map.covisibility import SeenPoints, covisibility
from modp_ti.files.errors import InputError

__all__ = ["Part", "cut"]

# Least number of own frames of a part. A shorter one costs more to start than to map.
LEAST = 8
# How far a cut may lie from where the parts would be of equal length [shares of a part].
SLACK = 0.1
# Most frames that a part has beyond each of its ends [shares of a part].
MARGIN = 0.1
# Overlap with the frame at the cut, see `covisibility`, below which frames beyond it are of no use to a part.
SEES_TOO = 0.3


@dataclass(frozen=True)
class Part:
    """A part of a recording. Frames are named by their positions in it.

    Attributes:
        number: Number of the part, from 1.
        own: The frames that belong to it.
        frames: The frames that it is mapped from: its own, and those of its neighbours that see the same.
    """

    number: int
    own: range
    frames: range


def cut(views: Sequence[SeenPoints], parts: int) -> list[Part]:
    """Cut a recording into parts of about the same number of frames.

    Near where the parts would be equally long, each cut is made where the frames before and after it have the least in
    common. Each part also gets the frames beyond its cuts that see what its frames at the cut see.

    Args:
        views: What each frame sees.
        parts: Number of parts.

    Returns:
        The parts, in order. Each frame is an own frame of one of them.

    Raises:
        InputError: If the recording is too short for so many parts.
    """
    if len(views) < LEAST * parts:
        most = len(views) // LEAST
        instead = f"at most {most} parts" if most >= 2 else "no parts"
        raise InputError(f"the recording has {len(views)} frames, too few for {parts} parts: take {instead}")
    length = len(views) / parts
    margin = max(int(MARGIN * length), 1)
    slack = int(SLACK * length)
    cuts = [_best_cut(views, round(number * length), slack, margin) for number in range(1, parts)]
    ends = [0, *cuts, len(views)]
    return [
        Part(
            number,
            range(first, end),
            range(_before(views, first, margin), _after(views, end, margin)),
        )
        for number, (first, end) in enumerate(pairwise(ends), start=1)
    ]


def _best_cut(views: Sequence[SeenPoints], middle: int, slack: int, margin: int) -> int:
    """Return the position of the first frame after a cut near the middle.

    The frames a margin before and after it have the least in common. Of cuts where they have as little, that is taken
    whose two frames have the least, and then the nearest to the middle.
    """

    def common(place: int) -> tuple[float, float, int]:
        apart = covisibility(views[place - margin], views[place + margin - 1])
        return apart, covisibility(views[place - 1], views[place]), abs(place - middle)

    return min(range(middle - slack, middle + slack + 1), key=common)


def _before(views: Sequence[SeenPoints], first: int, margin: int) -> int:
    """Return the position of the first frame of a part whose own frames begin at `first`."""
    place = first
    while place > max(first - margin, 0) and covisibility(views[place - 1], views[first]) >= SEES_TOO:
        place -= 1
    return place


def _after(views: Sequence[SeenPoints], end: int, margin: int) -> int:
    """Return the position after the last frame of a part whose own frames end before `end`."""
    place = end
    while place < min(end + margin, len(views)) and covisibility(views[end - 1], views[place]) >= SEES_TOO:
        place += 1
    return place
