"""Where a camera is by the landmarks that it sees, and which of the map's landmarks it sees besides."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.klt.landmark_map import LandmarkMap
from modp_ti.inputs.klt.optical_flow import BORDER
from modp_ti.inputs.klt.patch_alignment import align_landmarks, reference_views
from modp_ti.inputs.multiview.camera_pose import pose_from_points, ray_errors, refine_pose

__all__ = ["FEWEST", "MAX_ERROR", "SIGMA", "localised", "realigned", "searched"]

MAX_ERROR = 3.0  # px: a landmark farther from where it should be is not followed on
SIGMA = 1.0  # px
FEWEST = 20  # landmarks that a pose rests upon
SEARCHED = 300  # landmarks of the map that are looked for in a keyframe


def localised(
    landmarks: LandmarkMap, ids: NDArray[np.int64], pixels: NDArray[np.float64], T_guess: NDArray[np.float64], seed: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
    """Pose (4, 4) from features, and which (N,) to keep: landmarks that agree, and all that are none yet."""
    known = np.flatnonzero(landmarks.known[ids])
    if len(known) < FEWEST:
        return None
    focal = landmarks.lens.focal
    xyz, rays = landmarks.xyz[ids[known]], landmarks.lens.rays(pixels[known])
    T = refine_pose(T_guess, xyz, rays, SIGMA / focal)
    good = ray_errors(T, xyz, rays) * focal < MAX_ERROR
    if good.sum() < 0.7 * len(known):
        found = pose_from_points(xyz, rays, MAX_ERROR / focal, seed)
        if found is not None and found[1].sum() > good.sum():
            T = refine_pose(found[0], xyz[found[1]], rays[found[1]], SIGMA / focal)
            good = ray_errors(T, xyz, rays) * focal < MAX_ERROR
    if good.sum() < max(FEWEST, 0.3 * len(known)):
        return None
    kept = np.ones(len(ids), dtype=bool)
    kept[known] = good
    return T, kept


def searched(
    landmarks: LandmarkMap,
    T: NDArray[np.float64],
    grey: NDArray[np.uint8],
    ids: NDArray[np.int64],
    pixels: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Landmarks (M,) of the map that should be in view and are not among `ids`, found there; their pixels."""
    height, width = grey.shape
    candidate = landmarks.known.copy()
    candidate[ids] = False
    candidate &= (landmarks.looked < 4) | (landmarks.found > 0.25 * landmarks.looked)
    candidate = np.flatnonzero(candidate)
    at = landmarks.lens.pixels(landmarks.xyz[candidate] @ T[:3, :3].T + T[:3, 3])
    inside = np.isfinite(at).all(axis=1)
    inside[inside] = ((at[inside] >= BORDER) & (at[inside] <= (width - BORDER, height - BORDER))).all(axis=1)
    candidate, at = candidate[inside], at[inside]
    if len(candidate) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 2))
    keyframe, pixel, visible = reference_views(landmarks, candidate, T)
    candidate, at, keyframe, pixel = candidate[visible], at[visible], keyframe[visible], pixel[visible]
    chosen = _spread(at, SEARCHED, width, height, landmarks.found[candidate])
    candidate, at, keyframe, pixel = candidate[chosen], at[chosen], keyframe[chosen], pixel[chosen]
    there, found = align_landmarks(landmarks, candidate, keyframe, pixel, grey, T, at)
    landmarks.looked[candidate] += 1
    landmarks.found[candidate[found]] += 1
    return candidate[found], there[found]


def realigned(
    landmarks: LandmarkMap,
    T: NDArray[np.float64],
    grey: NDArray[np.uint8],
    ids: NDArray[np.int64],
    pixels: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Pixels (N, 2) of followed features, landmarks moved to where the keyframe that saw them first says."""
    pixels = pixels.copy()
    known = np.flatnonzero(landmarks.known[ids])
    keyframe, pixel, visible = reference_views(landmarks, ids[known], T)
    known, keyframe, pixel = known[visible], keyframe[visible], pixel[visible]
    there, found = align_landmarks(landmarks, ids[known], keyframe, pixel, grey, T, pixels[known])
    near = found & (np.linalg.norm(there - pixels[known], axis=1) < MAX_ERROR)
    pixels[known[near]] = there[near]
    return pixels


def _spread(
    pixels: NDArray[np.float64], count: int, width: int, height: int, merit: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Places (M,) of at most `count` of the pixels (N, 2), spread over the image, those of most merit first."""
    if len(pixels) <= count:
        return np.arange(len(pixels))
    cell = max(1.0, np.sqrt(width * height / count))
    of_cell = np.floor(pixels[:, 1] / cell).astype(np.int64) * 100_000 + np.floor(pixels[:, 0] / cell).astype(np.int64)
    order = np.lexsort((np.arange(len(pixels)), -merit, of_cell))
    rank = np.arange(len(order)) - np.searchsorted(of_cell[order], of_cell[order])
    return order[np.lexsort((order, rank))[:count]]
