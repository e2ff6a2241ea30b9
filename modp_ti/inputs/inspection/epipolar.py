"""Epipolar test of poses and intrinsics with matched features, which were found without either of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.inspection.conventions import Convention
from modp_ti.inputs.multiview.features import Features, essential_matrix, match_anywhere
from modp_ti.inputs.multiview.reprojection import estimated

__all__ = ["EpipolarScore", "MatchedPair", "epipolar_score", "matched_pair"]

LEAST_MATCHES = 30
# Thresholds of RANSAC and of a fitting match, in px of the image used for detection.
RANSAC_BAND = 1.5
FITS = 2.5
# Smallest angle [degrees] between the rays of a match at which the sign of its depth is reliable.
LEAST_ANGLE = 0.5


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


def matched_pair(a: int, features_a: Features, b: int, features_b: Features) -> MatchedPair | None:
    """Match two images without using their poses.

    Args:
        a: Index of the first frame.
        features_a: Its features.
        b: Index of the second frame.
        features_b: Its features.

    Returns:
        The matches that are inliers of a fundamental matrix; None if there are too few.
    """
    import cv2

    pairs = match_anywhere(features_a, features_b).pairs
    if len(pairs) < LEAST_MATCHES:
        return None
    pixels_a, pixels_b = features_a.pixels[pairs[:, 0]], features_b.pixels[pairs[:, 1]]
    pixel = max(features_a.pixel, features_b.pixel)
    cv2.setRNGSeed(0)
    band = RANSAC_BAND * pixel
    found = estimated(cv2.findFundamentalMat, pixels_a, pixels_b, cv2.USAC_MAGSAC, band, 0.999, 5000)
    inlier = None if found is None else found[1]
    if inlier is None or inlier.sum() < LEAST_MATCHES:
        return None
    kept = inlier.ravel() > 0
    return MatchedPair(a, b, pixels_a[kept], pixels_b[kept], pixel)


def epipolar_score(
    pairs: Sequence[MatchedPair],
    cameras: Sequence[PinholeCamera],
    poses: Sequence[NDArray[np.float64]],
    convention: Convention,
) -> EpipolarScore:
    """Measure how matches fit cameras and poses under a convention.

    A match fits if its Sampson error is below `FITS` px and its rays meet in front of both cameras.

    Args:
        pairs: The matches.
        cameras: Camera of each frame.
        poses: T_camera_world (4, 4) of each frame.
        convention: The interpretation of cameras and poses.
    """
    fits: list[NDArray[np.bool_]] = [np.zeros(0, dtype=bool)]
    errors: list[NDArray[np.float64]] = [np.zeros(0)]
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
        fits.append((error < FITS * pair.pixel) & _before_both(x_a, x_b, T_b @ np.linalg.inv(T_a)))
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
