"""Recognition of places: similar keyframes by VLAD [Jegou et al. 2010] over RootSIFT, and poses by SIFT matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3, motion_around, moved_pose, scale_of
from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap, unprojected
from modp_ti.inputs.multiview.appearance import vlad, vocabulary
from modp_ti.inputs.multiview.features import Features, epipolar_lines, essential_matrix, match_anywhere
from modp_ti.inputs.multiview.reprojection import pose_from_points, ray_errors

# Thresholds in px of the tracked image. MAX_ERROR is RANSAC's, and is wide because many depths are those of neighbours.
# A SIFT feature nearer than AT_LANDMARK to a landmark takes its depth.
MAX_ERROR = 5.0
AT_LANDMARK = 0.06
MAX_OFF_LINE = 3.0  # distance to the epipolar line
NEIGHBOURHOOD = 40.0  # distance to landmarks from which a depth is interpolated
FEWEST = 15  # fewest inlier matches of a pose
THUMBNAIL = (32, 24)
WORDS = 64
TRAINED_ON = 20_000  # descriptors, at most
FEWEST_PLACED = 25  # matches with depth in both keyframes
MAX_ERROR_BETWEEN = 8.0  # px, of a point of the one map in the keyframe of the other
LEAST_SHARE = 0.6  # of the matches that must be that near
LARGEST_SPREAD = 0.25  # median deviation of the ratio of depths, relative
# Differences between two recognitions that agree: of a camera's place relative to the scene's depth, its direction
# [radians], and the scale.
SAME_PLACE, SAME_DIRECTION, SAME_SCALE = 0.06, 0.05, 0.1
AGREEING = 3  # keyframes whose recognitions must agree before two places are connected
PAUSE = 5  # keyframes after a loop, or a join that was refused, in which none is sought


def thumbnail(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    """A small blurred image as a vector with mean 0 and length 1; zero for an image without contrast."""
    small = cv2.GaussianBlur(cv2.resize(grey, THUMBNAIL, interpolation=cv2.INTER_AREA), (5, 5), 0).astype(np.float32)
    small -= small.mean()
    return (small / max(float(np.linalg.norm(small)), 1.0)).reshape(-1)


def place_by_features(
    landmarks: LandmarkMap,
    keyframe: Keyframe,
    features: Features,
    pairs: NDArray[np.int64],
    seed: int,
    assumed: bool = False,
) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
    """Localise a frame by SIFT matches with a keyframe.

    Args:
        landmarks: The map.
        keyframe: One of its keyframes.
        features: SIFT features of the frame.
        pairs: (M, 2) matches of both: indices of SIFT features in the keyframe and in the frame.
        seed: Seed of RANSAC.
        assumed: Whether features count whose depth is not certain; then more must agree.

    Returns:
        T_camera_world (4, 4) of the frame, and the matches (N, 2) that agree. None if too few agree.
    """
    if len(pairs) < FEWEST:
        return None
    xyz = world_points(landmarks, keyframe, assumed)[pairs[:, 0]]
    placed = np.isfinite(xyz).all(axis=1)
    if placed.sum() < FEWEST:
        return None
    rays = landmarks.lens.rays(features.pixels[pairs[:, 1]])
    found = pose_from_points(xyz[placed], rays[placed], MAX_ERROR / landmarks.lens.focal, seed)
    fewest, share = (2 * FEWEST, 0.5) if assumed else (FEWEST, 0.2)
    if found is None or found[1].sum() < max(fewest, share * placed.sum()):
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
    described = keyframe.described
    a, b = described.pixels[pairs[:, 0]], features.pixels[pairs[:, 1]]
    rays_a, rays_b = landmarks.lens.rays(a), landmarks.lens.rays(b)
    lines = epipolar_lines(essential_matrix(keyframe.T_camera_world, T), rays_a)
    off = np.abs((lines * np.c_[rays_b, np.ones(len(b))]).sum(axis=1))
    good = off * landmarks.lens.focal < MAX_OFF_LINE
    slots, b = pairs[good, 0], b[good]
    slots, first = np.unique(slots, return_index=True)
    b = b[first]
    fresh = keyframe.described_ids[slots] < 0
    ids = landmarks.new_ids(int(fresh.sum()))
    keyframe.described_ids[slots[fresh]] = ids
    landmarks.observe(k, ids, described.pixels[slots[fresh]])
    return keyframe.described_ids[slots], b


def world_points(landmarks: LandmarkMap, keyframe: Keyframe, assumed: bool = False) -> NDArray[np.float64]:
    """World points (M, 3) of a keyframe's SIFT features; NaN where the depth is unknown.

    A feature that is a landmark has its position. Any other takes the depth of a landmark at the same pixel, or of the
    landmarks around it if they agree; if `assumed`, even if they do not.
    """
    pixels, ids = keyframe.described.pixels, keyframe.described_ids
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
    at_one = away.min(axis=1) < AT_LANDMARK
    z = np.where(at_one, around[np.arange(len(around)), away.argmin(axis=1)], middle)
    lent = np.flatnonzero((agree | at_one | assumed) & ~np.isfinite(xyz[:, 0]) & (z > 0))
    xyz[lent] = unprojected(T, landmarks.lens.rays(pixels[lent]), z[lent])
    return xyz


class PlaceIndex:
    """Image descriptors of keyframes.

    The vocabulary is learned when it is first needed, and again when there are twice as many keyframes.

    Args:
        seed: Seed of the vocabulary.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._words = np.zeros((0, 128), np.float32)
        self._trained_on = 0  # keyframes
        self._vectors: dict[int, NDArray[np.float32]] = {}  # by number of the keyframe

    def alike(self, keyframe: Keyframe, others: Sequence[Keyframe], count: int, least: float = -np.inf) -> list[int]:
        """Indices of the `count` others most similar to a keyframe, best first, whose cosine is at least `least`."""
        if not others:
            return []
        if len(others) + 1 >= 2 * self._trained_on:
            rows = [each.described.descriptors for each in (keyframe, *others)]
            stride = max(1, -(-sum(map(len, rows)) // TRAINED_ON))
            self._words = vocabulary(np.concatenate(rows)[::stride], WORDS, self._seed)
            self._trained_on = len(rows)
            self._vectors.clear()
        mine = self._vector(keyframe)
        likeness = np.array([self._vector(other) @ mine for other in others], np.float32)
        return [int(k) for k in np.argsort(-likeness, kind="stable")[:count] if likeness[k] >= least]

    def _vector(self, keyframe: Keyframe) -> NDArray[np.float32]:
        vector = self._vectors.get(keyframe.number)
        if vector is None:
            vector = self._vectors[keyframe.number] = vlad(keyframe.described.descriptors, self._words)
        return vector


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
    placed = place_by_features(landmarks, of, by.described, match_anywhere(of.described, by.described), seed)
    if placed is None:
        return None
    T, pairs = placed
    there, here = world_points(landmarks, of)[pairs[:, 0]], world_points(own, by)[pairs[:, 1]]
    both = np.isfinite(there).all(axis=1) & np.isfinite(here).all(axis=1)
    if both.sum() < FEWEST_PLACED:
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
    rays = landmarks.lens.rays(of.described.pixels[pairs[both, 0]])
    error = ray_errors(of.T_camera_world, here @ S[:3, :3].T + S[:3, 3], rays) * landmarks.lens.focal
    if (error < MAX_ERROR_BETWEEN).mean() < LEAST_SHARE:
        return None
    return Recognition(of, by, pairs, S, T, float(np.median(z_of)))


def agreeing(found: Sequence[Recognition], newest: Recognition) -> list[Recognition]:
    """Those recognitions that lead to the same similarity as the newest one, which is among them."""
    return [each for each in found if each is newest or _agree(each, newest)]


def turn_and_shift(T_a: NDArray[np.float64], T_b: NDArray[np.float64]) -> tuple[float, float]:
    """The turn [radians] and the distance between two poses (4, 4) of a camera."""
    off = T_a @ inverse_se3(T_b)
    return float(np.arccos(np.clip((np.trace(off[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))), float(np.linalg.norm(off[:3, 3]))


def _agree(one: Recognition, other: Recognition) -> bool:
    """Whether the similarity of the one leads the camera of the other to where it was found, and the reverse."""
    if abs(np.log(scale_of(one.S_of_by) / scale_of(other.S_of_by))) > SAME_SCALE:
        return False
    for a, b in ((one, other), (other, one)):
        turn, shift = turn_and_shift(moved_pose(a.S_of_by, b.by.T_camera_world), b.T_camera_world)
        if shift > SAME_PLACE * b.depth or turn > SAME_DIRECTION:
            return False
    return True
