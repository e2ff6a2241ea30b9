"""Checks of the image sequence: sizes, time stamps, blurred and repeated frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import wraps

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.inspection.finding import Finding, note, warning
from modp_ti.inputs.inspection.survey import FrameRecord

__all__ = ["blurred", "duplicates", "judge_sequence", "time_gaps"]

# A frame is blurred if its sharpness is below this factor of the median of the AROUND frames on each side. The factor
# is the default of keyframe selection.
BLURRED = 0.75
AROUND = 7
# Mean difference of thumbnails [grey levels] below which two images are the same, encoded twice.
SAME = 0.2
# A time step of more than this many times the median is a gap.
GAP = 3.0
# Shares of the frames above which blurred or repeated ones are a warning rather than a note.
MANY_BLURRED, MANY_DUPLICATES = 0.2, 0.1
NAMED = 5  # frames that a finding names, at most


def each_view(check: Callable[[Sequence[FrameRecord]], list[int]]) -> Callable[[Sequence[FrameRecord]], list[int]]:
    """Apply a check to the frames of each view of a rig by themselves, and return the indices of all frames found."""

    @wraps(check)
    def checked(frames: Sequence[FrameRecord]) -> list[int]:
        views = frames[0].views if frames else 1
        return sorted(view + views * i for view in range(views) for i in check(frames[view::views]))

    return checked


@each_view
def blurred(frames: Sequence[FrameRecord]) -> list[int]:
    """Indices of frames that are less sharp than their neighbours."""
    sharp = np.array([frame.sharpness for frame in frames])
    result = []
    for i, value in enumerate(sharp):
        around = np.delete(sharp[max(0, i - AROUND) : i + AROUND + 1], min(i, AROUND))
        if len(around) and value < BLURRED * np.median(around):
            result.append(i)
    return result


@each_view
def duplicates(frames: Sequence[FrameRecord]) -> list[int]:
    """Indices of frames whose image repeats the one before."""
    return [i for i, frame in enumerate(frames) if frame.change < SAME and frame.masked < 1]


@each_view
def time_gaps(frames: Sequence[FrameRecord]) -> list[int]:
    """Indices of frames that follow a gap in time."""
    steps = np.diff([frame.timestamp for frame in frames])
    if len(steps) == 0 or np.median(steps) <= 0:
        return []
    return (np.flatnonzero(steps > GAP * np.median(steps)) + 1).tolist()


@each_view
def steps_back(frames: Sequence[FrameRecord]) -> list[int]:
    """Indices of frames that are not later than the one before."""
    return (np.flatnonzero(np.diff([frame.timestamp for frame in frames]) <= 0) + 1).tolist()


def judge_sequence(frames: Sequence[FrameRecord]) -> Iterator[Finding]:
    """Judge image sizes, time stamps and image quality."""
    sizes = sorted({(frame.camera.width, frame.camera.height) for frame in frames})
    if len(sizes) > 1:
        yield note("sizes", f"images of several sizes: {', '.join(f'{w}x{h}' for w, h in sizes)}")
    back = steps_back(frames)
    if len(back):
        text = f"time does not go on at {len(back)} frames: {_names(frames, back)}"
        yield warning("time_order", text, "sort the frames by time, or mend the times")
    gaps = time_gaps(frames)
    if gaps:
        yield note("time_gaps", f"{len(gaps)} gaps in time, before {_names(frames, gaps)}")
    slower = "record slower or with more light, or leave these frames out"
    fewer = "take them out, or use source.step"
    for code, found, most, what, mend in (
        ("blurred", blurred(frames), MANY_BLURRED, "are blurred", slower),
        ("duplicates", duplicates(frames), MANY_DUPLICATES, "repeat the one before", fewer),
    ):
        text = f"{len(found)} of {len(frames)} frames {what}: {_names(frames, found)}"
        if len(found) > most * len(frames):
            yield warning(code, text, mend)
        elif found:
            yield note(code, text)


def _names(frames: Sequence[FrameRecord], places: Sequence[int] | NDArray[np.int64]) -> str:
    names = [frames[int(i)].name for i in places[:NAMED]]
    return ", ".join(names) + (f" and {len(places) - NAMED} more" if len(places) > NAMED else "")
