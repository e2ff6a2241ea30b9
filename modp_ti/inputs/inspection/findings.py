"""Findings with corrections: of the images, their times, the points and the camera's motion; and a verdict."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import camera_centres
from modp_ti.inputs.inspection.survey import FrameRecord
from modp_ti.inputs.replay import ALL_HELD_OUT

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
# Extent of the camera path, in scene depths, below which there is no parallax.
LEAST_WAY = 0.01
# Step between frames, in scene depths, above which consecutive images hardly overlap.
LONG_STEP = 0.5
# Largest plausible distance of the principal point from the image centre, as a share of the image size.
OFF_CENTRE = 0.15
# Largest plausible ratio of fx and fy for a camera with square pixels.
ANAMORPHIC = 1.1
FIELD_OF_VIEW = (20.0, 130.0)  # range of plausible horizontal fields of view [degrees]


class Severity(Enum):
    """Severity of a finding, in increasing order."""

    NOTE = "note"
    WARNING = "warning"
    UNUSABLE = "unusable"


@dataclass(frozen=True)
class Finding:
    """One finding.

    Attributes:
        severity: How severe it is.
        code: A machine-readable identifier.
        text: The finding in one line.
        mend: How to correct it; may be empty.
    """

    severity: Severity
    code: str
    text: str
    mend: str = ""


note = partial(Finding, Severity.NOTE)
warning = partial(Finding, Severity.WARNING)
unusable = partial(Finding, Severity.UNUSABLE)


def verdict(findings: Iterable[Finding]) -> tuple[str, int]:
    """Summarise findings as "fine", "warnings" or "unusable", with `modp-ti check`'s exit code 0, 1 or 2."""
    severities = {finding.severity for finding in findings}
    if Severity.UNUSABLE in severities:
        return "unusable", 2
    return ("warnings", 1) if Severity.WARNING in severities else ("fine", 0)


def faulty_frames(frames: Sequence[FrameRecord]) -> dict[str, list[int]]:
    """Indices of faulty frames, where each view of a rig is judged by itself.

    Returns:
        By fault: `blurred`, less sharp than their neighbours; `duplicates`, whose image repeats the one before;
        `time_gaps`, which follow a gap in time; `time_order`, which are not later than the one before.
    """
    found: dict[str, list[int]] = {"time_order": [], "time_gaps": [], "blurred": [], "duplicates": []}
    views = frames[0].views if frames else 1
    for view in range(views):
        own = frames[view::views]
        sharp, steps = np.array([frame.sharpness for frame in own]), np.diff([frame.timestamp for frame in own])
        usual = np.median(steps) if len(steps) else 0.0
        for i, frame in enumerate(own):
            around = np.delete(sharp[max(0, i - AROUND) : i + AROUND + 1], min(i, AROUND))
            faults = {
                "time_order": i > 0 and steps[i - 1] <= 0,
                "time_gaps": i > 0 and usual > 0 and steps[i - 1] > GAP * usual,
                "blurred": len(around) > 0 and sharp[i] < BLURRED * np.median(around),
                "duplicates": frame.change < SAME and frame.masked < 1,
            }
            for fault in (name for name, is_so in faults.items() if is_so):
                found[fault].append(view + views * i)
    return {fault: sorted(indices) for fault, indices in found.items()}


def judge_sequence(frames: Sequence[FrameRecord]) -> Iterator[Finding]:
    """Judge image sizes, time stamps and image quality."""
    sizes = sorted({(frame.camera.width, frame.camera.height) for frame in frames})
    if len(sizes) > 1:
        yield note("sizes", f"images of several sizes: {', '.join(f'{w}x{h}' for w, h in sizes)}")
    faulty = faulty_frames(frames)
    back, gaps = faulty["time_order"], faulty["time_gaps"]
    if back:
        text = f"time does not go on at {len(back)} frames: {_names(frames, back)}"
        yield warning("time_order", text, "sort the frames by time, or mend the times")
    if gaps:
        yield note("time_gaps", f"{len(gaps)} gaps in time, before {_names(frames, gaps)}")
    slower = "record slower or with more light, or leave these frames out"
    fewer = "take them out, or use source.step"
    for code, most, what, mend in (
        ("blurred", MANY_BLURRED, "are blurred", slower),
        ("duplicates", MANY_DUPLICATES, "repeat the one before", fewer),
    ):
        found = faulty[code]
        text = f"{len(found)} of {len(frames)} frames {what}: {_names(frames, found)}"
        if len(found) > most * len(frames):
            yield warning(code, text, mend)
        elif found:
            yield note(code, text)


def _names(frames: Sequence[FrameRecord], places: Sequence[int] | NDArray[np.int64]) -> str:
    names = [frames[int(i)].name for i in places[:NAMED]]
    return ", ".join(names) + (f" and {len(places) - NAMED} more" if len(places) > NAMED else "")


@dataclass(frozen=True)
class Scale:
    """Depth of the scene, and motion of the camera relative to it.

    Attributes:
        depth: Median over the frames of the median depth of their points [scene units]; NaN without points.
        step: Median distance between consecutive camera centres, in depths.
        longest: Largest distance between consecutive camera centres, in depths.
        extent: Diagonal of the bounding box of all camera centres, in depths.
    """

    depth: float
    step: float
    longest: float
    extent: float


def measure_scale(frames: Sequence[FrameRecord]) -> Scale:
    """Measure depth and camera motion. There must be at least one frame."""
    depths = np.array([frame.depth for frame in frames])
    depth = float(np.nanmedian(depths)) if np.isfinite(depths).any() else float("nan")
    places = camera_centres([frame.T_camera_world for frame in frames[:: frames[0].views]])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1) / depth
    extent = float(np.linalg.norm(np.ptp(places, axis=0)) / depth)
    if len(steps) == 0:
        return Scale(depth, 0.0, 0.0, extent)
    return Scale(depth, float(np.median(steps)), float(steps.max()), extent)


def judge_scale(frames: Sequence[FrameRecord], scale: Scale, min_points: int) -> Iterator[Finding]:
    """Judge the number of points, the camera's motion and its intrinsics.

    Args:
        frames: Measurements of each frame.
        scale: Depth of the scene and motion of the camera.
        min_points: Points that a keyframe needs.
    """
    mapped = [frame for frame in frames if not frame.held_out]
    poor = [frame for frame in mapped if frame.points < min_points]
    if not mapped:
        yield unusable("held_out", ALL_HELD_OUT)
    elif len(poor) == len(mapped):
        yield unusable(
            "points",
            f"no frame has {min_points} tracked points: none can become a keyframe",
            "if poses or intrinsics are wrong, mend these first; else give a tracker with points, or lower "
            "mapping.keyframes.min_points",
        )
    elif poor:
        text = f"{len(poor)} of {len(mapped)} frames have fewer than {min_points} tracked points"
        yield (warning if len(poor) > 0.5 * len(mapped) else note)("points", text)
    if np.isfinite(scale.depth) and scale.extent < LEAST_WAY:
        yield warning(
            "no_parallax",
            f"the camera moves by only {scale.extent:.2g} of the scene's depth: nothing is seen from two sides",
            "move the camera, not only turn it; if it did move, the poses' scale is not that of the points",
        )
    if np.isfinite(scale.depth) and scale.longest > LONG_STEP:
        text = f"the camera moves by up to {scale.longest:.2g} of the scene's depth between two frames"
        yield note("long_steps", text)
    yield from _judge_camera(frames[0].camera)


def _judge_camera(c: PinholeCamera) -> Iterator[Finding]:
    if max(abs(c.cx / c.width - 0.5), abs(c.cy / c.height - 0.5)) > OFF_CENTRE:
        yield warning(
            "principal_point",
            f"the principal point ({c.cx:.1f}, {c.cy:.1f}) is far from the middle of {c.width}x{c.height} pixels",
            "check that the intrinsics are of images of this size, and cx and cy not exchanged",
        )
    ratio = max(c.fx / c.fy, c.fy / c.fx)
    if ratio > ANAMORPHIC:
        text = f"fx {c.fx:.1f} and fy {c.fy:.1f} differ by {100 * (ratio - 1):.0f} %"
        yield warning("focal_lengths", text, "check that the images were not stretched")
    view = 2 * np.degrees(np.arctan(0.5 * c.width / c.fx))
    if not FIELD_OF_VIEW[0] <= view <= FIELD_OF_VIEW[1]:
        yield warning("field_of_view", f"the camera sees {view:.0f} degrees across", "check the focal length")
