"""One pass over a tracker's frames: what is measured of each while it is there."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.inspection.conventions import CONVENTIONS, Convention
from modp_ti.inputs.inspection.epipolar import MatchedPair, matched_pair
from modp_ti.inputs.inspection.reprojection import reprojection_errors
from modp_ti.inputs.multiview.features import Features, detect_features
from pipelines.select.sharpness import sharpness

__all__ = ["FrameRecord", "Survey", "survey"]

# Features are matched between a frame and those so many behind it, at so many places of the sequence.
GAPS = (1, 2, 4)
PLACES = 8
# Where the number of frames is not known before: every so many frames.
LIVE_SPACING = 25
THUMBNAIL = 64  # [px] longer side


@dataclass(frozen=True)
class FrameRecord:
    """What is kept of a frame.

    points: tracked ones. depth: their median [scene units], NaN without. sharpness: as `pipelines.select.sharpness`.
    change: mean difference to the frame before [grey levels of 255], at thumbnail size; NaN for the first. masked:
    share of pixels that do not count.
    """

    index: int
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


@dataclass
class Survey:
    """All frames' records, matched pairs of some of them, and reprojection errors [px] by convention."""

    frames: list[FrameRecord] = field(default_factory=list)
    pairs: list[MatchedPair] = field(default_factory=list)
    reprojection: dict[Convention, NDArray[np.float32]] = field(default_factory=dict)


def survey(frames: Iterable[TrackedFrame], total: int | None, seen: Callable[[int], None]) -> Survey:
    """Look at every frame once.

    total: how many there will be, None where that is not known. seen: called after each with how many there were.
    """
    result = Survey()
    errors: dict[Convention, list[NDArray[np.float32]]] = {c: [] for c in CONVENTIONS}
    features: dict[int, Features] = {}
    anchors = None if total is None else set(np.linspace(0, max(total - 1 - GAPS[-1], 0), PLACES).astype(int).tolist())
    before: NDArray[np.float32] | None = None
    for place, frame in enumerate(frames):
        rgb = np.ascontiguousarray(frame.rgba[..., :3])
        thumbnail = _thumbnail(rgb)
        result.frames.append(_record(frame, rgb, thumbnail, before))
        before = thumbnail
        for convention in CONVENTIONS:
            errors[convention].append(reprojection_errors(frame, convention))

        wanted = [a for a in range(max(place - GAPS[-1], 0), place + 1) if _is_anchor(a, anchors)]
        if any(place - a in (0, *GAPS) for a in wanted):
            features[place] = detect_features(rgb)
        for a in wanted:
            if place - a in GAPS and a in features:
                pair = matched_pair(a, features[a], place, features[place])
                if pair is not None:
                    result.pairs.append(pair)
        features.pop(place - GAPS[-1], None)
        seen(place + 1)
    result.reprojection = {c: np.concatenate([np.zeros(0, np.float32), *each]) for c, each in errors.items()}
    return result


def _is_anchor(place: int, anchors: set[int] | None) -> bool:
    if anchors is None:
        return place % LIVE_SPACING == 0 and place < PLACES * LIVE_SPACING
    return place in anchors


def _record(
    frame: TrackedFrame, rgb: NDArray[np.uint8], thumbnail: NDArray[np.float32], before: NDArray[np.float32] | None
) -> FrameRecord:
    depths = frame.points.depths(frame.T_camera_world)
    depths = depths[depths > 0]
    comparable = before is not None and before.shape == thumbnail.shape
    return FrameRecord(
        index=frame.index,
        name=frame.name,
        timestamp=frame.timestamp,
        camera=frame.camera,
        T_camera_world=frame.T_camera_world,
        held_out=frame.held_out,
        points=len(frame.points),
        depth=float(np.median(depths)) if len(depths) else float("nan"),
        sharpness=sharpness(rgb),
        change=float(np.abs(thumbnail - before).mean()) if comparable else float("nan"),
        masked=0.0 if frame.mask is None else float(1.0 - frame.mask.mean()),
    )


def _thumbnail(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    height, width = rgb.shape[:2]
    factor = min(1.0, THUMBNAIL / max(height, width))
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
