"""Check whether poses, intrinsics and points fit the images, and if not, under which convention they would."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.inspection.conventions import CONVENTIONS, STATED, Convention
from modp_ti.inputs.inspection.epipolar import EpipolarScore, epipolar_score
from modp_ti.inputs.inspection.finding import Finding, note, unusable, warning
from modp_ti.inputs.inspection.survey import Survey

__all__ = ["LEAST_MATCHES", "Geometry", "best_convention", "judge_geometry", "measure_geometry"]

# With fewer matches or points, nothing is concluded.
LEAST_MATCHES = 100
LEAST_POINTS = 50
# Pixels with a smaller error [px] were computed from the points and prove nothing.
COMPUTED = 1e-3
# Shares of fitting matches. Measured on desk, fox and redkitchen with injected errors: with correct input, 99 % of the
# matches fit with a median of 0.15 px; with a wrong convention, at most 79 % with 0.6 px or more.
FITS, DOUBTFUL = 0.85, 0.6
# Another convention is reported only if its error is at most this factor of the stated one's, and its share of fitting
# matches larger by this much.
BETTER_ERROR, BETTER_SHARE = 0.5, 0.1
# Largest median reprojection error of fitting points, as a share of the image's diagonal.
POINTS_FIT = 0.01


@dataclass(frozen=True)
class Geometry:
    """Agreement of features and points with the poses, for each convention.

    Attributes:
        epipolar: Agreement of the matched features.
        reprojection: Median reprojection error [px] of the points.
        points: Number of point observations; 0 if their pixels were computed from the poses and so prove nothing.
        diagonal: Diagonal of the image [px].
    """

    epipolar: Mapping[Convention, EpipolarScore]
    reprojection: Mapping[Convention, float]
    points: int
    diagonal: float


def measure_geometry(survey: Survey, further: Callable[[int], Sequence[NDArray[np.float64]]] | None = None) -> Geometry:
    """Measure the agreement under each convention. The survey must have at least one frame.

    Args:
        survey: The measurements.
        further: Returns T_camera_world (4, 4) of the frames so many places after those of the survey; None if it has
            all frames.
    """
    cameras = [frame.camera for frame in survey.frames]
    poses = [frame.T_camera_world for frame in survey.frames]

    def moved(shift: int) -> Sequence[NDArray[np.float64]]:
        places = np.arange(len(poses)) + shift * survey.frames[0].views
        return [poses[i] for i in np.clip(places, 0, len(poses) - 1)] if further is None else further(shift)

    epipolar = {c: epipolar_score(survey.pairs, cameras, moved(c.shift), c) for c in CONVENTIONS}
    medians = {c: float(np.median(e)) if len(e) else float("inf") for c, e in survey.reprojection.items()}
    count = len(survey.reprojection[STATED])
    if medians[STATED] < COMPUTED:
        count = 0
    diagonal = float(np.hypot(cameras[0].width, cameras[0].height))
    return Geometry(epipolar, medians, count, diagonal)


def judge_geometry(geometry: Geometry) -> Iterator[Finding]:
    """Judge poses and intrinsics by the matched features if there are enough, otherwise by the points."""
    if geometry.epipolar[STATED].matches >= LEAST_MATCHES:
        yield from _by_features(geometry)
    elif geometry.points >= LEAST_POINTS:
        yield from _by_points(geometry)
    else:
        yield note(
            "poses_not_judged",
            "poses and intrinsics could not be judged: too few features match between neighbouring frames, "
            "and no observed points",
        )


def best_convention(geometry: Geometry) -> Convention:
    """Return the convention that the matched features fit far better than that stated, or the stated one."""
    stated, best = geometry.epipolar[STATED], min(CONVENTIONS, key=lambda c: geometry.epipolar[c].error)
    score = geometry.epipolar[best]
    better = score.error < BETTER_ERROR * stated.error and score.share >= stated.share + BETTER_SHARE
    return best if better and score.share >= DOUBTFUL else STATED


def _by_features(geometry: Geometry) -> Iterator[Finding]:
    stated, best = geometry.epipolar[STATED], best_convention(geometry)
    score = geometry.epipolar[best]
    numbers = f"{stated.share:.0%} of {stated.matches:,} matched features fit, median error {stated.error:.2f} px"
    if best is not STATED:
        text = f"{best.fault}: as stated {numbers}; so read {score.share:.0%}, {score.error:.2f} px"
        yield unusable(_code(best), text, best.mend)
        return
    if stated.share < DOUBTFUL:
        text = f"the poses do not fit the images, under no convention that was tried: as stated {numbers}"
        mend = "check that poses and images are of the same recording and in the same order, and the intrinsics"
        yield unusable("poses_do_not_fit", text, mend)
        return
    if stated.share < FITS:
        text = f"the poses fit the images only roughly: {numbers}"
        mend = "check time stamps (an offset between poses and images), intrinsics and distortion"
        yield warning("poses_imprecise", text, mend)
    error = geometry.reprojection[STATED]
    if geometry.points >= LEAST_POINTS and error > POINTS_FIT * geometry.diagonal:
        yield warning(
            "points_do_not_fit",
            f"the poses fit the images, but the points do not fit the poses: median reprojection error {error:.1f} px",
            "give the points of the same run as the poses, in the same world and scale",
        )


def _by_points(geometry: Geometry) -> Iterator[Finding]:
    best = min(CONVENTIONS, key=lambda c: geometry.reprojection[c])
    stated, error = geometry.reprojection[STATED], geometry.reprojection[best]
    limit = POINTS_FIT * geometry.diagonal
    if stated <= limit:
        return
    if best is not STATED and error <= limit and error < BETTER_ERROR * stated:
        text = f"as stated the points' median reprojection error is {stated:.1f} px, so read {error:.2f} px"
        yield unusable(_code(best), f"{best.fault}: {text}", best.mend)
        return
    text = f"the points do not fit poses and intrinsics, under no convention that was tried: {stated:.1f} px"
    yield unusable("points_do_not_fit", text, "check that poses, points and images are of the same recording")


def _code(convention: Convention) -> str:
    return convention.name.lower().replace(" ", "_")
