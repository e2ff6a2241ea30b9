"""Measurements of all frames in a single pass over a tracker."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.inspection.conventions import CONVENTIONS, Convention
from modp_ti.inputs.multiview.features import Features, detect_features, match_anywhere
from modp_ti.inputs.multiview.reprojection import estimated, pixel_errors
from pipelines.select.gate import sharpness

# At PLACES frames of the sequence, features are matched with the frames of the same view GAPS times further on.
GAPS = (1, 2, 4)
PLACES = 8
# Distance between these places if the number of frames is unknown.
LIVE_SPACING = 25
THUMBNAIL = 64  # [px] longer side
# Fewest matches of a pair, and the threshold of RANSAC in px of the image used for detection.
FEWEST_MATCHES = 30
RANSAC_BAND = 1.5


@dataclass(frozen=True)
class MatchedPair:
    """Matches of two images that are consistent with a common epipolar geometry.

    Attributes:
        a: Index of the first frame.
        b: Index of the second frame.
        pixels_a: (M, 2) features in the first image.
        pixels_b: (M, 2) features in the second image.
        pixel: Pixel size of the images used for detection, in pixels of the mapped image.
    """

    a: int
    b: int
    pixels_a: NDArray[np.float64]
    pixels_b: NDArray[np.float64]
    pixel: float


@dataclass(frozen=True)
class FrameRecord:
    """Measurements of a frame.

    Attributes:
        name: Its name.
        timestamp: Its time in seconds.
        camera: Its camera.
        T_camera_world: (4, 4) its pose.
        held_out: Whether it is held out.
        points: Number of tracked points.
        depth: Their median depth [scene units]; NaN without points.
        sharpness: Sharpness as in `pipelines.select.gate`.
        change: Mean difference to the frame before of the same view [grey levels of 255] at thumbnail size; NaN for the
            first frame.
        masked: Share of masked pixels.
        views: Number of views that are taken at one time.
    """

    name: str
    timestamp: float
    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]
    held_out: bool
    points: int
    depth: float
    sharpness: float
    change: float
    masked: float
    views: int = 1


@dataclass
class Survey:
    """Measurements of all frames.

    Attributes:
        frames: Measurements of each frame.
        pairs: Matches between some of the frames.
        reprojection: Reprojection errors [px] of all point observations, by convention.
    """

    frames: list[FrameRecord] = field(default_factory=list)
    pairs: list[MatchedPair] = field(default_factory=list)
    reprojection: dict[Convention, NDArray[np.float32]] = field(default_factory=dict)


def survey(
    frames: Iterable[TrackedFrame], total: int | None, seen: Callable[[int], None], places: int = PLACES
) -> Survey:
    """Measure every frame in one pass.

    Args:
        frames: The frames.
        total: Number of frames; None if unknown.
        seen: Called after each frame with the number of frames so far.
        places: Number of frames whose features are matched with those further on.
    """
    result = Survey()
    errors: dict[Convention, list[NDArray[np.float32]]] = {c: [] for c in CONVENTIONS}
    features: dict[int, Features] = {}
    anchors = range(0, places * LIVE_SPACING, LIVE_SPACING)
    if total is not None:
        anchors = set(np.linspace(0, max(total - 1 - GAPS[-1], 0), places).astype(int).tolist())
    before: dict[int, NDArray[np.float32]] = {}  # by view
    for place, frame in enumerate(frames):
        view, gaps = place % frame.views, [gap * frame.views for gap in GAPS]
        rgb = np.ascontiguousarray(frame.rgba[..., :3])
        thumbnail = _thumbnail(rgb)
        result.frames.append(_record(frame, rgb, thumbnail, before.get(view)))
        before[view] = thumbnail
        for convention in CONVENTIONS:
            errors[convention].append(_reprojection_errors(frame, convention))

        wanted = [a for a in range(max(place - gaps[-1], 0), place + 1) if a in anchors]
        if any(place - a in (0, *gaps) for a in wanted):
            features[place] = detect_features(rgb)
        for a in wanted:
            if place - a in gaps and a in features:
                pair = _matched_pair(a, features[a], place, features[place])
                if pair is not None:
                    result.pairs.append(pair)
        features.pop(place - gaps[-1], None)
        seen(place + 1)
    result.reprojection = {c: np.concatenate([np.zeros(0, np.float32), *each]) for c, each in errors.items()}
    return result


def _record(
    frame: TrackedFrame, rgb: NDArray[np.uint8], thumbnail: NDArray[np.float32], before: NDArray[np.float32] | None
) -> FrameRecord:
    depths = frame.points.depths(frame.T_camera_world)
    depths = depths[depths > 0]
    change = float("nan")
    if before is not None and before.shape == thumbnail.shape:
        change = float(np.abs(thumbnail - before).mean())
    return FrameRecord(
        name=frame.name,
        timestamp=frame.timestamp,
        camera=frame.camera,
        T_camera_world=frame.T_camera_world,
        held_out=frame.held_out,
        points=len(frame.points),
        depth=float(np.median(depths)) if len(depths) else float("nan"),
        sharpness=sharpness(rgb),
        change=change,
        masked=0.0 if frame.mask is None else float(1.0 - frame.mask.mean()),
        views=frame.views,
    )


def _reprojection_errors(frame: TrackedFrame, convention: Convention) -> NDArray[np.float32]:
    """Reprojection errors (N,) [px] of a frame's points under a convention; infinite for points behind the camera."""
    if convention.shift:  # the points are not those of that image
        return np.full(len(frame.points), np.inf, dtype=np.float32)
    T, camera = convention.pose(frame.T_camera_world), convention.camera(frame.camera)
    return pixel_errors(camera, T, frame.points.xyz, frame.points.pixels).astype(np.float32)


def _thumbnail(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    height, width = rgb.shape[:2]
    factor = min(1.0, THUMBNAIL / max(height, width))
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.float32)


def _matched_pair(a: int, features_a: Features, b: int, features_b: Features) -> MatchedPair | None:
    """Match frames a and b without their poses: the inliers of a fundamental matrix; None if there are too few."""
    pairs = match_anywhere(features_a, features_b)
    if len(pairs) < FEWEST_MATCHES:
        return None
    pixels_a, pixels_b = features_a.pixels[pairs[:, 0]], features_b.pixels[pairs[:, 1]]
    pixel = max(features_a.pixel, features_b.pixel)
    cv2.setRNGSeed(0)
    band = RANSAC_BAND * pixel
    found = estimated(cv2.findFundamentalMat, pixels_a, pixels_b, cv2.USAC_MAGSAC, band, 0.999, 5000)
    inlier = None if found is None else found[1]
    if inlier is None or inlier.sum() < FEWEST_MATCHES:
        return None
    kept = inlier.ravel() > 0
    return MatchedPair(a, b, pixels_a[kept], pixels_b[kept], pixel)
