"""Connection of keyframes that recognise each other, and joining of two maps that show the same places."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap
from modp_ti.inputs.klt.localisation import searched
from modp_ti.inputs.klt.recognition import (
    AGREEING,
    PAUSE,
    PlaceIndex,
    Recognition,
    agreeing,
    inherited,
    recognised,
    world_points,
)
from modp_ti.inputs.klt.tracking import Tracking
from modp_ti.inputs.multiview.reprojection import estimated, ray_errors

ROUNDS = 2  # bundle adjustments, each without the outliers of the one before
# The map contradicts a connection if the residuals of more of the connecting observations, or of the others, are those
# of outliers after the adjustment.
LARGEST_LOSS, LARGEST_DAMAGE = 0.5, 0.04
CANDIDATES = 3  # keyframes of another map with which a keyframe is compared
MAX_ERROR = 5.0  # px
MAX_ERROR_3D = 0.05  # of corresponding points, relative to their depth


def connected(landmarks: LandmarkMap, found: Sequence[Recognition], apart: bool = False) -> bool:
    """Connect keyframes, and bundle adjust the whole map.

    Args:
        landmarks: The map, in which the keyframes of each recognition are in about the right place.
        found: The recognitions.
        apart: Adjust in a process of its own, so that other threads go on.

    Returns:
        Whether the adjusted map agrees. If not, it is of no use.
    """
    every = range(len(landmarks.keyframes))
    observed = len(landmarks.observations(every)[1])
    made = [_connect(landmarks, each) for each in found]
    for _ in range(ROUNDS):
        if not np.isfinite(landmarks.adjust(every, steps=10, apart=apart)):
            return False
        landmarks.discard_outliers(every)
    kept = sum(int(np.isin(ids, keyframe.ids).sum()) for keyframe, ids in made)
    total = sum(len(ids) for _, ids in made)
    agree = total > 0 and kept >= (1.0 - LARGEST_LOSS) * total
    return agree and len(landmarks.observations(every)[1]) - kept >= (1.0 - LARGEST_DAMAGE) * observed


def _connect(landmarks: LandmarkMap, found: Recognition) -> tuple[Keyframe, NDArray[np.int64]]:
    """Let a keyframe observe landmarks of the one that it recognises. Returns it and their ids (N,)."""
    of, by = landmarks.index(found.of.number), landmarks.index(found.by.number)
    keyframe = landmarks.keyframes[by]
    frame = keyframe.frame()
    before = len(frame.ids)
    frame.append(*inherited(landmarks, of, keyframe.described, found.pairs, frame.T_camera_world))
    frame.append(*searched(landmarks, frame))
    ids = frame.ids[before:]
    landmarks.observe(by, ids, frame.pixels[before:])
    return keyframe, ids[landmarks.known[ids]]


class MapJoining:
    """Finds out which map shows the place of the map that is being tracked.

    Args:
        seed: Seed of RANSAC and of the vocabulary.

    Attributes:
        refused: Number of joins that the joint map contradicted.
    """

    def __init__(self, seed: int) -> None:
        self.refused = 0
        self._index = PlaceIndex(seed)
        self._seed = seed
        self._pause: tuple[Tracking, int] | None = None  # a map, and its number of keyframes until which it rests
        self._found: list[tuple[Tracking, Tracking, Recognition]] = []

    def found(self, active: Tracking, others: Sequence[Tracking]) -> tuple[Tracking, list[Recognition]] | None:
        """Compare the last keyframe of a map with the keyframes of other maps.

        Returns:
            The other map with at least AGREEING recognitions that agree; None if there is none.
        """
        by = active.map.keyframes[-1]
        if self._pause is not None and active is self._pause[0] and len(active.map.keyframes) < self._pause[1]:
            return None
        candidates = [(other, keyframe) for other in others for keyframe in other.map.keyframes]
        for at in self._index.alike(by, [keyframe for _, keyframe in candidates], CANDIDATES):
            other, of = candidates[at]
            recognition = recognised(other.map, of, active.map, by, self._seed)
            if recognition is None:
                continue
            self._found.append((active, other, recognition))
            same = [each for one, two, each in self._found if one is active and two is other]
            same = agreeing(same, recognition)
            if len({each.by.number for each in same}) >= AGREEING:
                self._found.clear()  # the maps change
                return other, same
        return None

    def refuse(self, active: Tracking) -> None:
        """Note that the joint map contradicted what was found, so that the same is not found again at once."""
        self.refused += 1
        self._pause = active, len(active.map.keyframes) + PAUSE


def joint_similarity(
    landmarks: LandmarkMap, own: LandmarkMap, found: Sequence[Recognition], seed: int
) -> NDArray[np.float64]:
    """The similarity S_of_by (4, 4) that fits the matches of all recognitions best.

    One is estimated from all pairs of matched points; it competes with those of the single recognitions by the number
    of points that it leads to where the other map sees them.

    Args:
        landmarks: The map of the recognised keyframes.
        own: The map of the keyframes that recognised them.
        found: Recognitions that agree.
        seed: Seed of RANSAC.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    matched = []  # for each recognition, pairs of points in the two worlds, and the rays of `of` to them
    for each in found:
        a, b = each.pairs.T
        there, here = world_points(landmarks, each.of)[a], world_points(own, each.by)[b]
        good = np.isfinite(np.c_[there, here]).all(axis=1)
        rays = landmarks.lens.rays(each.of.described.pixels[a[good]])
        matched.append((there[good], here[good], rays))
    options = pycolmap.RANSACOptions()
    options.max_error = MAX_ERROR_3D * float(np.median([each.depth for each in found]))
    options.random_seed = seed
    there, here = (np.concatenate([each[i] for each in matched]) for i in range(2))
    candidates = [each.S_of_by for each in found]
    together = estimated(pycolmap.estimate_sim3d_robust, here, there, options)
    if together is not None:
        # The declared type leaves out the dictionary around the transform.
        matrix = together["tgt_from_src"].matrix()  # pyright: ignore[reportIndexIssue]
        candidates.append(np.vstack([matrix, (0.0, 0.0, 0.0, 1.0)]))

    def fitting(S: NDArray[np.float64]) -> int:
        count = 0
        for each, (_, here, rays) in zip(found, matched, strict=True):
            error = ray_errors(each.of.T_camera_world, here @ S[:3, :3].T + S[:3, 3], rays)
            count += int((error * landmarks.lens.focal < MAX_ERROR).sum())
        return count

    return max(candidates, key=fitting)
