"""Check whether poses, intrinsics and points fit the images, and if not, under which convention they would.

The matched features were found without poses and intrinsics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.inputs.inspection.conventions import CONVENTIONS, STATED, Convention
from modp_ti.inputs.inspection.findings import Finding, Severity, note, unusable, warning
from modp_ti.inputs.inspection.survey import GAPS, MatchedPair, Survey, survey
from modp_ti.inputs.multiview.features import essential_matrix
from modp_ti.inputs.protocol import Tracker

FITTING = 2.5  # px of the image used for detection, threshold of a fitting match
# Smallest angle [degrees] between the rays of a match at which the sign of its depth is reliable.
LEAST_ANGLE = 0.5
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
# Features are matched at PLACES of the recording, between images that are up to APART times the survey's gaps apart.
PLACES, APART = 3, 5
# Poses are nonsense if fewer matches fit, where another convention fits well and where none does. On desk, fox,
# redkitchen (by COLMAP, stella_vslam and the depth camera), courthouse and university, 90 to 100 % fit.
FEW, FEW_WITHOUT_REMEDY = 0.6, 0.35
# Without matches: least median reprojection error of nonsense, as a share of the image's diagonal.
FAR_OFF = 0.05


@dataclass(frozen=True)
class EpipolarScore:
    """Agreement of matches with poses and intrinsics.

    Attributes:
        share: Share of the matches that fit.
        error: Median Sampson error of all matches [px of the mapped image]; NaN without matches.
        matches: Number of matches.
    """

    share: float
    error: float
    matches: int


def epipolar_score(
    pairs: Sequence[MatchedPair],
    cameras: Sequence[PinholeCamera],
    poses: Sequence[NDArray[np.float64]],
    convention: Convention,
) -> EpipolarScore:
    """Measure how matches fit cameras and poses under a convention.

    A match fits if its Sampson error is below `FITTING` px and its rays meet in front of both cameras.

    Args:
        pairs: The matches.
        cameras: Camera of each frame.
        poses: T_camera_world (4, 4) of each frame.
        convention: The interpretation of cameras and poses.
    """
    fits, errors = [np.zeros(0, dtype=bool)], [np.zeros(0)]
    for pair in pairs:
        camera_a, camera_b = convention.camera(cameras[pair.a]), convention.camera(cameras[pair.b])
        T_a, T_b = convention.pose(poses[pair.a]), convention.pose(poses[pair.b])
        ones = np.ones(len(pair.pixels_a))
        x_a, x_b = camera_a.unproject(pair.pixels_a, ones), camera_b.unproject(pair.pixels_b, ones)
        E = essential_matrix(T_a, T_b)
        if np.linalg.norm(E) == 0:
            continue  # pure rotation has no epipolar geometry
        line_b, line_a = x_a @ E.T, x_b @ E
        residual = (x_b * line_b).sum(axis=1)
        slope = np.linalg.norm(np.c_[line_a[:, :2], line_b[:, :2]], axis=1)
        error = np.abs(residual) / np.maximum(slope, 1e-300) * camera_b.focal
        fits.append((error < FITTING * pair.pixel) & _before_both(x_a, x_b, T_b @ np.linalg.inv(T_a)))
        errors.append(error)
    fitting, error = np.concatenate(fits), np.concatenate(errors)
    if len(fitting) == 0:
        return EpipolarScore(0.0, float("nan"), 0)
    return EpipolarScore(float(fitting.mean()), float(np.median(error)), len(fitting))


def _before_both(x_a: NDArray[np.float64], x_b: NDArray[np.float64], T_b_a: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the rays (M, 3) are closest to each other in front of both cameras, or too parallel to decide."""
    a = x_a @ T_b_a[:3, :3].T  # in the axes of b
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, x_b))
    cosine = (a * b).sum(axis=1)
    sine2 = 1.0 - cosine**2
    t = T_b_a[:3, 3]
    # t + s a = u b in the least-squares sense.
    s = (cosine * (b @ t) - a @ t) / np.maximum(sine2, 1e-12)
    u = (b @ t - cosine * (a @ t)) / np.maximum(sine2, 1e-12)
    return (sine2 < np.sin(np.radians(LEAST_ANGLE)) ** 2) | ((s > 0) & (u > 0))


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


def _best_convention(geometry: Geometry) -> Convention:
    """Return the convention that the matched features fit far better than that stated, or the stated one."""
    stated, best = geometry.epipolar[STATED], min(CONVENTIONS, key=lambda c: geometry.epipolar[c].error)
    score = geometry.epipolar[best]
    better = score.error < BETTER_ERROR * stated.error and score.share >= stated.share + BETTER_SHARE
    return best if better and score.share >= DOUBTFUL else STATED


def _by_features(geometry: Geometry) -> Iterator[Finding]:
    stated, best = geometry.epipolar[STATED], _best_convention(geometry)
    score = geometry.epipolar[best]
    numbers = f"{stated.share:.0%} of {stated.matches:,} matched features fit, median error {stated.error:.2f} px"
    if best is not STATED:
        text = f"{best.fault}: as stated {numbers}; so read {score.share:.0%}, {score.error:.2f} px"
        yield unusable(best.code, text, best.mend)
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
        yield unusable(best.code, f"{best.fault}: {text}", best.mend)
        return
    text = f"the points do not fit poses and intrinsics, under no convention that was tried: {stated:.1f} px"
    yield unusable("points_do_not_fit", text, "check that poses, points and images are of the same recording")


def require_fitting(tracker: Tracker) -> None:
    """Raise InputError if the poses of a tracker cannot be those of some of its images. It stays at its start.

    Poses with errors that mapping corrects must pass, so that more must be wrong than for `judge_geometry`, unless
    another convention fits well.
    """
    looked_at = list(tracker.sampled(APART, GAPS[-1] + 1, PLACES))
    if not looked_at:
        return
    last = len(tracker.frames) - 1

    def further(shift: int) -> Sequence[NDArray[np.float64]]:
        return [tracker.frames[min(max(place + shift, 0), last)].T_camera_world for place, _ in looked_at]

    seen = survey((frame for _, frame in looked_at), len(looked_at), lambda _: None, PLACES)
    geometry = measure_geometry(seen, further)
    stated = geometry.epipolar[STATED]
    few = FEW_WITHOUT_REMEDY if _best_convention(geometry) is STATED else FEW
    if stated.matches >= LEAST_MATCHES:
        fits = stated.share >= few
    else:
        fits = geometry.reprojection[STATED] <= FAR_OFF * geometry.diagonal
    unfit = [] if fits else [each for each in judge_geometry(geometry) if each.severity is Severity.UNUSABLE]
    if unfit:
        reason = f"{unfit[0].text}; {unfit[0].mend}"
        raise InputError(f"{reason}; --force maps it all the same (modp-ti check says more)")
