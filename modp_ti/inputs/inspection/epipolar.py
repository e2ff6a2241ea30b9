"""Do poses and intrinsics fit the images? Asked of matched features, which know nothing of either."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.inspection.conventions import Convention
from modp_ti.inputs.multiview.features import Features, essential_matrix, match_features

__all__ = ["EpipolarScore", "MatchedPair", "epipolar_score", "matched_pair"]

LEAST_MATCHES = 30
# Pixels of the searched image.
RANSAC_BAND = 1.5
FITS = 2.5
# Below this angle between its two rays [degrees], a match does not tell before from behind.
LEAST_ANGLE = 0.5


@dataclass(frozen=True)
class MatchedPair:
    """Matches of two images that agree with one another under some epipolar geometry.

    a, b: places of the images among the frames. pixels_a, pixels_b: (M, 2). pixel: of the searched images [px].
    """

    a: int
    b: int
    pixels_a: NDArray[np.float64]
    pixels_b: NDArray[np.float64]
    pixel: float


@dataclass(frozen=True)
class EpipolarScore:
    """Share of the matches that fit, and their median Sampson error [px of the mapped image]; matches: how many."""

    share: float
    error: float
    matches: int


def matched_pair(a: int, features_a: Features, b: int, features_b: Features) -> MatchedPair | None:
    """The matches of two images; None where too few agree, or where the image hardly moved."""
    import cv2

    nowhere = np.zeros((3, 3))
    rays = (np.zeros((len(each.pixels), 2)) for each in (features_a, features_b))
    found = match_features(features_a.descriptors, features_b.descriptors, *rays, nowhere, np.inf)
    if len(found) < LEAST_MATCHES:
        return None
    pixels_a, pixels_b = features_a.pixels[found.pairs[:, 0]], features_b.pixels[found.pairs[:, 1]]
    pixel = max(features_a.pixel, features_b.pixel)
    cv2.setRNGSeed(0)
    _, inlier = cv2.findFundamentalMat(pixels_a, pixels_b, cv2.USAC_MAGSAC, RANSAC_BAND * pixel, 0.999, 5000)
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
    """How the matches fit the frames' cameras and T_camera_world (4, 4), read after the convention."""
    fits: list[NDArray[np.bool_]] = [np.zeros(0, dtype=bool)]
    errors: list[NDArray[np.float64]] = [np.zeros(0)]
    for pair in pairs:
        camera_a, camera_b = convention.camera(cameras[pair.a]), convention.camera(cameras[pair.b])
        T_a, T_b = convention.pose(poses[pair.a]), convention.pose(poses[pair.b])
        x_a, x_b = _rays(camera_a, pair.pixels_a), _rays(camera_b, pair.pixels_b)
        E = essential_matrix(T_a, T_b)
        if np.linalg.norm(E) == 0:
            continue  # a camera that only turned says nothing
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


def _rays(camera: PinholeCamera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    return camera.unproject(pixels, np.ones(len(pixels)))


def _before_both(x_a: NDArray[np.float64], x_b: NDArray[np.float64], T_b_a: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the rays (M, 3) of two cameras come nearest to each other before both, or are too parallel to tell."""
    a = x_a @ T_b_a[:3, :3].T  # in the axes of b
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, x_b))
    cosine = (a * b).sum(axis=1)
    sine2 = 1.0 - cosine**2
    t = T_b_a[:3, 3]
    # t + s a = u b in the least squares.
    s = (cosine * (b @ t) - a @ t) / np.maximum(sine2, 1e-12)
    u = (b @ t - cosine * (a @ t)) / np.maximum(sine2, 1e-12)
    return (sine2 < np.sin(np.radians(LEAST_ANGLE)) ** 2) | ((s > 0) & (u > 0))
