"""Localisation of frames by SIFT matches with a keyframe, where optical flow fails."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap
from modp_ti.inputs.multiview.features import Features, detect_features, essential_matrix, match_anywhere
from modp_ti.inputs.multiview.reprojection import pose_from_points

__all__ = [
    "alike_keyframes",
    "describe",
    "described_keyframe",
    "inherited",
    "place_by_features",
    "thumbnail",
    "world_points",
]

# Thresholds in px of the tracked image. MAX_ERROR is RANSAC's, and is wide because many depths are those of neighbours.
# A SIFT feature nearer than SAME_PLACE to a landmark takes its depth.
MAX_ERROR = 5.0
SAME_PLACE = 2.0
MAX_OFF_LINE = 3.0  # distance to the epipolar line
NEIGHBOURHOOD = 40.0  # distance to landmarks from which a depth is interpolated
FEWEST = 15  # fewest inlier matches of a pose
THUMBNAIL = (32, 24)
DESCRIBED_SIDE = 400  # longer side at which SIFT features are detected: 60 % of the time that 640 px take


def describe(grey: NDArray[np.uint8]) -> Features:
    """SIFT features of a tracked image (H, W) uint8."""
    return detect_features(np.repeat(grey[..., None], 3, axis=2), side=DESCRIBED_SIDE)


def thumbnail(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    """A small blurred image as a vector with mean 0 and length 1; zero for an image without contrast."""
    small = cv2.GaussianBlur(cv2.resize(grey, THUMBNAIL, interpolation=cv2.INTER_AREA), (5, 5), 0).astype(np.float32)
    small -= small.mean()
    return (small / max(float(np.linalg.norm(small)), 1.0)).reshape(-1)


def alike_keyframes(thumbnails: NDArray[np.float32], grey: NDArray[np.uint8], count: int) -> list[int]:
    """Indices of the `count` keyframes whose thumbnails are most similar to the image, best first."""
    likeness = thumbnails @ thumbnail(grey)
    return [int(k) for k in np.argsort(-likeness, kind="stable")[:count]]


def place_by_features(
    landmarks: LandmarkMap, keyframe: Keyframe, features: Features, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
    """Localise a frame by SIFT matches with a keyframe.

    Args:
        landmarks: The map.
        keyframe: One of its keyframes.
        features: SIFT features of the frame.
        seed: Seed of RANSAC.

    Returns:
        T_camera_world (4, 4) of the frame, and the matches (M, 2) that agree: indices of SIFT features in the keyframe
        and in the frame. None if too few agree.
    """
    pairs = match_anywhere(described_keyframe(keyframe), features).pairs
    if len(pairs) < FEWEST:
        return None
    xyz = world_points(landmarks, keyframe)[pairs[:, 0]]
    placed = np.isfinite(xyz).all(axis=1)
    if placed.sum() < FEWEST:
        return None
    rays = landmarks.lens.rays(features.pixels[pairs[:, 1]])
    found = pose_from_points(xyz[placed], rays[placed], MAX_ERROR / landmarks.lens.focal, seed)
    if found is None or found[1].sum() < max(FEWEST, 0.2 * placed.sum()):
        return None
    agreeing = np.ones(len(pairs), dtype=bool)
    agreeing[placed] = found[1]
    return found[0], pairs[agreeing]


def inherited(
    landmarks: LandmarkMap, k: int, features: Features, pairs: NDArray[np.int64], T: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Turn SIFT matches with keyframe k into tracked features.

    Matches far from their epipolar lines are dropped. SIFT features without an id get one and are added to the
    keyframe's observations.

    Args:
        landmarks: The map.
        k: Index of the keyframe.
        features: SIFT features of the frame.
        pairs: (M, 2) matches of `place_by_features`.
        T: (4, 4) T_camera_world of the frame.

    Returns:
        Ids (N,) and their pixels (N, 2) in the frame.
    """
    keyframe = landmarks.keyframes[k]
    described = described_keyframe(keyframe)
    a, b = described.pixels[pairs[:, 0]], features.pixels[pairs[:, 1]]
    rays_a, rays_b = landmarks.lens.rays(a), landmarks.lens.rays(b)
    lines = np.c_[rays_a, np.ones(len(a))] @ essential_matrix(keyframe.T_camera_world, T).T
    off = np.abs((lines * np.c_[rays_b, np.ones(len(b))]).sum(axis=1))
    off /= np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-12)
    good = off * landmarks.lens.focal < MAX_OFF_LINE
    slots, b = pairs[good, 0], b[good]
    slots, first = np.unique(slots, return_index=True)
    b = b[first]
    fresh = keyframe.described_ids[slots] < 0
    ids = landmarks.new_ids(int(fresh.sum()))
    keyframe.described_ids[slots[fresh]] = ids
    pixels = described.pixels[slots[fresh]]
    keyframe.append(ids, pixels, landmarks.lens.rays(pixels))
    landmarks.note_observations(k, ids, pixels)
    return keyframe.described_ids[slots], b


def described_keyframe(keyframe: Keyframe) -> Features:
    """SIFT features of a keyframe, detected when they are first needed."""
    if keyframe.described is None:
        keyframe.described = describe(keyframe.grey)
        keyframe.described_ids = np.full(len(keyframe.described.pixels), -1, dtype=np.int64)
    return keyframe.described


def world_points(landmarks: LandmarkMap, keyframe: Keyframe) -> NDArray[np.float64]:
    """World points (M, 3) of a keyframe's SIFT features; NaN where the depth is unknown.

    A feature that is a landmark has its position. Any other takes the depth of a landmark at the same pixel, or of the
    landmarks around it if they agree.
    """
    pixels, ids = described_keyframe(keyframe).pixels, keyframe.described_ids
    xyz = np.full((len(pixels), 3), np.nan)
    own = np.flatnonzero(ids >= 0)
    own = own[landmarks.known[ids[own]]]
    xyz[own] = landmarks.xyz[ids[own]]
    seen = np.flatnonzero(landmarks.known[keyframe.ids])
    if len(seen) < 3 or len(pixels) == 0:
        return xyz
    T = keyframe.T_camera_world
    depth = landmarks.xyz[keyframe.ids[seen]] @ T[2, :3] + T[2, 3]
    distance = np.linalg.norm(pixels[:, None] - keyframe.pixels[seen][None], axis=2)
    nearest = np.argpartition(distance, 2, axis=1)[:, :3]
    away = np.take_along_axis(distance, nearest, axis=1)
    around = depth[nearest]
    middle = np.median(around, axis=1)
    agree = (np.ptp(around, axis=1) < 0.1 * middle) & (away.max(axis=1) < NEIGHBOURHOOD) & (middle > 0)
    at_one = away.min(axis=1) < SAME_PLACE
    z = np.where(at_one, around[np.arange(len(around)), away.argmin(axis=1)], middle)
    lent = np.flatnonzero((agree | at_one) & ~np.isfinite(xyz[:, 0]) & (z > 0))
    point = np.c_[landmarks.lens.rays(pixels[lent]), np.ones(len(lent))] * z[lent, None] - T[:3, 3]
    xyz[lent] = point @ T[:3, :3]
    return xyz
