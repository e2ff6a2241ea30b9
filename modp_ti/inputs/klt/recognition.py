"""Geometric verification that two keyframes see one place, of one map or of two maps with worlds of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from fields.geometry.similarity import motion_around, moved_pose, scale_of
from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap
from modp_ti.inputs.klt.relocalisation import described_keyframe, place_by_features, world_points
from modp_ti.inputs.multiview.reprojection import ray_errors

__all__ = ["Recognition", "agreeing", "recognised"]

FEWEST = 25  # matches with depth in both keyframes
MAX_ERROR = 8.0  # px, of a point of the one map in the keyframe of the other
LEAST_SHARE = 0.6  # of the matches that must be that near
LARGEST_SPREAD = 0.25  # median deviation of the ratio of depths, relative
# Differences between two recognitions that agree: of a camera's place relative to the scene's depth, its direction
# [radians], and the scale.
SAME_PLACE, SAME_DIRECTION, SAME_SCALE = 0.06, 0.05, 0.1


@dataclass(frozen=True)
class Recognition:
    """A keyframe `by` that shows the place which an older keyframe `of` shows.

    Attributes:
        of: The older keyframe.
        by: The keyframe that recognises it.
        pairs: (M, 2) matches between their SIFT features.
        S_of_by: (4, 4) similarity from the world of `by` to that of `of`.
        T_camera_world: (4, 4) pose of `by` in the world of `of`.
        depth: Median depth of the matches in `by`, in the scale of the world of `of`.
    """

    of: Keyframe
    by: Keyframe
    pairs: NDArray[np.int64]
    S_of_by: NDArray[np.float64]
    T_camera_world: NDArray[np.float64]
    depth: float


def recognised(landmarks: LandmarkMap, of: Keyframe, own: LandmarkMap, by: Keyframe, seed: int) -> Recognition | None:
    """Recognise the place of keyframe `of` in keyframe `by`.

    The pose of `by` comes from matches with points of the other map; the scale from the depths of both. The points of
    `by` must then appear where `of` sees them.

    Args:
        landmarks: The map of `of`.
        of: A keyframe.
        own: The map of `by`, which may be the same one.
        by: Another keyframe.
        seed: Seed of RANSAC.
    """
    placed = place_by_features(landmarks, of, described_keyframe(by), seed)
    if placed is None:
        return None
    T, pairs = placed
    there, here = world_points(landmarks, of)[pairs[:, 0]], world_points(own, by)[pairs[:, 1]]
    both = np.isfinite(there).all(axis=1) & np.isfinite(here).all(axis=1)
    if both.sum() < FEWEST:
        return None
    there, here = there[both], here[both]
    z_of = there @ T[2, :3] + T[2, 3]
    z_by = here @ by.T_camera_world[2, :3] + by.T_camera_world[2, 3]
    if min(z_of.min(), z_by.min()) <= 0:
        return None
    ratio = np.log(z_of / z_by)
    middle = float(np.median(ratio))
    if np.median(np.abs(ratio - middle)) > LARGEST_SPREAD:
        return None
    S = motion_around(by.T_camera_world, T, float(np.exp(middle)))
    rays = landmarks.lens.rays(described_keyframe(of).pixels[pairs[both, 0]])
    error = ray_errors(of.T_camera_world, here @ S[:3, :3].T + S[:3, 3], rays) * landmarks.lens.focal
    if (error < MAX_ERROR).mean() < LEAST_SHARE:
        return None
    return Recognition(of, by, pairs, S, T, float(np.median(z_of)))


def agreeing(found: Sequence[Recognition], newest: Recognition) -> list[Recognition]:
    """Those recognitions that lead to the same similarity as the newest one, which is among them."""
    return [each for each in found if each is newest or _agree(each, newest)]


def _agree(one: Recognition, other: Recognition) -> bool:
    """Whether the similarity of the one leads the camera of the other to where it was found, and the reverse."""
    if abs(np.log(scale_of(one.S_of_by) / scale_of(other.S_of_by))) > SAME_SCALE:
        return False
    for a, b in ((one, other), (other, one)):
        off = moved_pose(a.S_of_by, b.by.T_camera_world) @ inverse_se3(b.T_camera_world)
        turn = np.arccos(np.clip((np.trace(off[:3, :3]) - 1) / 2, -1, 1))
        if np.linalg.norm(off[:3, 3]) > SAME_PLACE * b.depth or turn > SAME_DIRECTION:
            return False
    return True
