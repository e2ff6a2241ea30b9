"""What `modp-ti run` asks of given poses before it maps them: the cheap part of an inspection, on a few frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.inputs.inspection.conventions import STATED
from modp_ti.inputs.inspection.finding import Severity
from modp_ti.inputs.inspection.geometry import (
    LEAST_MATCHES,
    Geometry,
    best_convention,
    judge_geometry,
    measure_geometry,
)
from modp_ti.inputs.inspection.survey import GAPS, survey
from modp_ti.inputs.replay import ReplayedTracker

__all__ = ["first_look", "nonsense", "require_fitting"]

# Features are matched at PLACES of the recording, between images that are up to APART times the survey's gaps apart.
PLACES, APART = 3, 5

# Poses are nonsense if fewer matches fit, where another convention fits well and where none does. On desk, fox,
# redkitchen (by COLMAP, stella_vslam and the depth camera), courthouse and university, 90 to 100 % fit.
FEW, FEW_WITHOUT_REMEDY = 0.6, 0.35
# Without matches: least median reprojection error of nonsense, as a share of the image's diagonal.
FAR_OFF = 0.05


def first_look(tracker: ReplayedTracker) -> Geometry | None:
    """Measure how some frames of a tracker fit their poses, None without any. The tracker stays at its start."""
    looked_at = list(tracker.sampled(APART, GAPS[-1] + 1, PLACES))
    if not looked_at:
        return None
    last = len(tracker.frames) - 1

    def further(shift: int) -> Sequence[NDArray[np.float64]]:
        return [tracker.frames[min(max(place + shift, 0), last)].T_camera_world for place, _ in looked_at]

    seen = survey((frame for _, frame in looked_at), len(looked_at), lambda _: None, PLACES)
    return measure_geometry(seen, further)


def require_fitting(tracker: ReplayedTracker) -> None:
    """Raise InputError if the poses of a tracker cannot be those of its images."""
    geometry = first_look(tracker)
    reason = None if geometry is None else nonsense(geometry)
    if reason is not None:
        raise InputError(f"{reason}; --force maps it all the same (modp-ti check says more)")


def nonsense(geometry: Geometry) -> str | None:
    """Return in one line why poses cannot be those of the images, None if they may be.

    Poses with errors that mapping corrects must pass, so that more must be wrong than for `judge_geometry`, unless
    another convention fits well.
    """
    stated, error = geometry.epipolar[STATED], geometry.reprojection[STATED]
    few = FEW_WITHOUT_REMEDY if best_convention(geometry) is STATED else FEW
    by_features = stated.matches >= LEAST_MATCHES
    if stated.share >= few if by_features else error <= FAR_OFF * geometry.diagonal:
        return None
    unfit = [finding for finding in judge_geometry(geometry) if finding.severity is Severity.UNUSABLE]
    return f"{unfit[0].text}; {unfit[0].mend}" if unfit else None
