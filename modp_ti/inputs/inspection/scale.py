"""Checks of the number of points, the scale of the camera's motion, and the intrinsics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import camera_centres
from modp_ti.inputs.inspection.finding import Finding, note, unusable, warning
from modp_ti.inputs.inspection.survey import FrameRecord
from modp_ti.inputs.replay import ALL_HELD_OUT

__all__ = ["Scale", "judge_scale", "measure_scale"]

# Extent of the camera path, in scene depths, below which there is no parallax.
LEAST_WAY = 0.01
# Step between frames, in scene depths, above which consecutive images hardly overlap.
LONG_STEP = 0.5
# Largest plausible distance of the principal point from the image centre, as a share of the image size.
OFF_CENTRE = 0.15
# Largest plausible ratio of fx and fy for a camera with square pixels.
ANAMORPHIC = 1.1
FIELD_OF_VIEW = (20.0, 130.0)  # range of plausible horizontal fields of view [degrees]


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
