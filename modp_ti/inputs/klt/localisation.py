"""Localisation of a frame by its landmarks, and search for further landmarks of the map in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.klt.frame import Frame, LocalisedFrame
from modp_ti.inputs.klt.landmark_map import LandmarkMap
from modp_ti.inputs.klt.optical_flow import BORDER
from modp_ti.inputs.klt.patch_alignment import align_landmarks, reference_views
from modp_ti.inputs.multiview.reprojection import pose_from_points, ray_errors, refine_pose

__all__ = ["FEWEST", "MAX_ERROR", "SIGMA", "localised", "predicted_pixels", "realigned", "searched"]

MAX_ERROR = 3.0  # landmarks with a larger reprojection error [px] are no longer tracked
SIGMA = 1.0  # px, scale of the robust loss
FEWEST = 20  # fewest landmarks for a pose
SEARCHED = 300  # landmarks of the map that are searched for in a keyframe, at most


def localised(landmarks: LandmarkMap, frame: Frame, T_guess: NDArray[np.float64], seed: int) -> LocalisedFrame | None:
    """Localise a frame by its features.

    Args:
        landmarks: The map.
        frame: The frame.
        T_guess: (4, 4) initial T_camera_world.
        seed: Seed of RANSAC, which runs if too few landmarks agree with the pose refined from `T_guess`.

    Returns:
        The frame with its pose, with the inlier landmarks and all features that are not triangulated. None if too few
        landmarks agree.
    """
    known = np.flatnonzero(landmarks.known[frame.ids])
    if len(known) < FEWEST:
        return None
    focal = landmarks.lens.focal
    xyz, rays = landmarks.xyz[frame.ids[known]], landmarks.lens.rays(frame.pixels[known])
    T = refine_pose(T_guess, xyz, rays, SIGMA / focal)
    good = ray_errors(T, xyz, rays) * focal < MAX_ERROR
    if good.sum() < 0.7 * len(known):
        found = pose_from_points(xyz, rays, MAX_ERROR / focal, seed)
        if found is not None and found[1].sum() > good.sum():
            T = refine_pose(found[0], xyz[found[1]], rays[found[1]], SIGMA / focal)
            good = ray_errors(T, xyz, rays) * focal < MAX_ERROR
    if good.sum() < max(FEWEST, 0.3 * len(known)):
        return None
    kept = np.ones(len(frame.ids), dtype=bool)
    kept[known] = good
    return LocalisedFrame(frame.number, frame.grey, frame.valid, frame.ids[kept], frame.pixels[kept], T_camera_world=T)


def predicted_pixels(
    landmarks: LandmarkMap, last: LocalisedFrame, T_camera_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Predict the pixels (N, 2) of a frame's features at another pose (4, 4).

    Untriangulated features are given the median depth.
    """
    lens, T, T_last = landmarks.lens, T_camera_world, last.T_camera_world
    known = landmarks.known[last.ids]
    world = landmarks.xyz[last.ids].copy()
    depth = world[known] @ T_last[2, :3] + T_last[2, 3]
    typical = float(np.median(depth)) if len(depth) else 1.0
    rays = lens.rays(last.pixels[~known])
    world[~known] = (np.c_[rays, np.ones(len(rays))] * typical - T_last[:3, 3]) @ T_last[:3, :3]
    guess = lens.pixels(world @ T[:3, :3].T + T[:3, 3])
    # The reprojection error of each feature is assumed to persist.
    guess = guess + (last.pixels - lens.pixels(world @ T_last[:3, :3].T + T_last[:3, 3]))
    return np.where(np.isfinite(guess).all(axis=1, keepdims=True), guess, last.pixels)


def searched(
    landmarks: LandmarkMap, frame: LocalisedFrame, elsewhere: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Search a frame for landmarks of the map that should be visible but are not tracked.

    Args:
        landmarks: The map.
        frame: The frame.
        elsewhere: (K,) ids that are not searched for, because other views of the same time have them.

    Returns:
        Ids (M,) of the landmarks that were found, and their pixels (M, 2).
    """
    T = frame.T_camera_world
    height, width = frame.grey.shape
    candidate = landmarks.known.copy()
    candidate[frame.ids] = False
    if elsewhere is not None:
        candidate[elsewhere] = False
    candidate &= (landmarks.looked < 4) | (landmarks.found > 0.25 * landmarks.looked)
    candidate = np.flatnonzero(candidate)
    at = landmarks.lens.pixels(landmarks.xyz[candidate] @ T[:3, :3].T + T[:3, 3])
    # Comparisons with NaN, for points behind the camera, are False.
    inside = ((at >= BORDER) & (at <= (width - BORDER, height - BORDER))).all(axis=1)
    candidate, at = candidate[inside], at[inside]
    if len(candidate) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 2))
    keyframe, pixel, visible = reference_views(landmarks, candidate, T)
    candidate, at, keyframe, pixel = candidate[visible], at[visible], keyframe[visible], pixel[visible]
    chosen = _spread(at, SEARCHED, width, height, landmarks.found[candidate])
    candidate, at, keyframe, pixel = candidate[chosen], at[chosen], keyframe[chosen], pixel[chosen]
    there, found = align_landmarks(landmarks, candidate, keyframe, pixel, frame.grey, T, at)
    landmarks.looked[candidate] += 1
    landmarks.found[candidate[found]] += 1
    return candidate[found], there[found]


def realigned(landmarks: LandmarkMap, frame: LocalisedFrame) -> NDArray[np.float64]:
    """Remove the drift of a frame's landmarks by aligning them with patches of earlier keyframes.

    Returns:
        Corrected positions (N, 2) of its N features. Those without a successful alignment keep theirs.
    """
    T, pixels = frame.T_camera_world, frame.pixels.copy()
    known = np.flatnonzero(landmarks.known[frame.ids])
    keyframe, pixel, visible = reference_views(landmarks, frame.ids[known], T)
    known, keyframe, pixel = known[visible], keyframe[visible], pixel[visible]
    there, found = align_landmarks(landmarks, frame.ids[known], keyframe, pixel, frame.grey, T, pixels[known])
    near = found & (np.linalg.norm(there - pixels[known], axis=1) < MAX_ERROR)
    pixels[known[near]] = there[near]
    return pixels


def _spread(
    pixels: NDArray[np.float64], count: int, width: int, height: int, merit: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Indices (M,) of at most `count` pixels (N, 2), spread over the image, with the highest `merit` first."""
    if len(pixels) <= count:
        return np.arange(len(pixels))
    cell = max(1.0, np.sqrt(width * height / count))
    of_cell = np.floor(pixels[:, 1] / cell).astype(np.int64) * 100_000 + np.floor(pixels[:, 0] / cell).astype(np.int64)
    order = np.lexsort((np.arange(len(pixels)), -merit, of_cell))
    rank = np.arange(len(order)) - np.searchsorted(of_cell[order], of_cell[order])
    return order[np.lexsort((order, rank))[:count]]
