"""Joining of two maps that show the same places."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.klt.frame import LocalisedFrame
from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap
from modp_ti.inputs.klt.localisation import searched
from modp_ti.inputs.klt.place_recognition import PlaceIndex
from modp_ti.inputs.klt.recognition import Recognition, agreeing, recognised
from modp_ti.inputs.klt.relocalisation import described_keyframe, inherited, world_points
from modp_ti.inputs.klt.tracking import Tracking
from modp_ti.inputs.multiview.reprojection import ray_errors

__all__ = ["MapJoining", "connect", "inverse_similarity", "joint_similarity"]

CANDIDATES = 3  # keyframes of another map with which a keyframe is compared
AGREEING = 3  # keyframes that must agree
MAX_ERROR_3D = 0.05  # of corresponding points, relative to their depth
MAX_ERROR = 5.0  # px


class MapJoining:
    """Finds out which map shows the place of the map that is being tracked.

    Args:
        index: Finds keyframes that look alike.
        seed: Seed of RANSAC.
    """

    def __init__(self, index: PlaceIndex, seed: int) -> None:
        self._index = index
        self._seed = seed
        self._found: list[tuple[Tracking, Tracking, Recognition]] = []

    def found(self, active: Tracking, others: Sequence[Tracking]) -> tuple[Tracking, list[Recognition]] | None:
        """Compare the last keyframe of a map with the keyframes of other maps.

        Returns:
            The other map with at least AGREEING recognitions that agree; None if there is none.
        """
        by = active.map.keyframes[-1]
        candidates = [(other, keyframe) for other in others for keyframe in other.map.keyframes]
        if not candidates:
            return None
        likeness = self._index.likeness(by, [keyframe for _, keyframe in candidates])
        for at in np.argsort(-likeness, kind="stable")[:CANDIDATES]:
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

    matched = [
        (world_points(landmarks, each.of)[each.pairs[:, 0]], world_points(own, each.by)[each.pairs[:, 1]])
        for each in found
    ]
    both = [np.isfinite(np.c_[there, here]).all(axis=1) for there, here in matched]
    candidates = [each.S_of_by for each in found]
    options = pycolmap.RANSACOptions()
    options.max_error = MAX_ERROR_3D * float(np.median([each.depth for each in found]))
    options.random_seed = seed
    there = np.concatenate([pair[0][good] for pair, good in zip(matched, both, strict=True)])
    here = np.concatenate([pair[1][good] for pair, good in zip(matched, both, strict=True)])
    together = pycolmap.estimate_sim3d_robust(here, there, options)
    if together is not None:
        # The declared type leaves out the dictionary around the transform.
        matrix = together["tgt_from_src"].matrix()  # pyright: ignore[reportIndexIssue]
        candidates.append(np.vstack([matrix, (0.0, 0.0, 0.0, 1.0)]))

    def fitting(S: NDArray[np.float64]) -> int:
        count = 0
        for each, (_, here), good in zip(found, matched, both, strict=True):
            rays = landmarks.lens.rays(described_keyframe(each.of).pixels[each.pairs[good, 0]])
            error = ray_errors(each.of.T_camera_world, here[good] @ S[:3, :3].T + S[:3, 3], rays)
            count += int((error * landmarks.lens.focal < MAX_ERROR).sum())
        return count

    return max(candidates, key=fitting)


def connect(landmarks: LandmarkMap, found: Sequence[Recognition]) -> list[tuple[Keyframe, NDArray[np.int64]]]:
    """Let keyframes observe the landmarks of the keyframes that they recognise, in one map and one world.

    Returns:
        The keyframes with the ids (N,) of their new observations.
    """
    place = {keyframe.number: k for k, keyframe in enumerate(landmarks.keyframes)}
    made = []
    for each in found:
        of, by = place[each.of.number], place[each.by.number]
        keyframe = each.by
        T = keyframe.T_camera_world
        frame = LocalisedFrame(keyframe.number, keyframe.grey, None, keyframe.ids, keyframe.pixels, T_camera_world=T)
        before = len(frame.ids)
        frame.append(*inherited(landmarks, of, described_keyframe(keyframe), each.pairs, T))
        frame.append(*searched(landmarks, frame))
        ids, pixels = frame.ids[before:], frame.pixels[before:]
        keyframe.append(ids, pixels, landmarks.lens.rays(pixels))
        landmarks.note_observations(by, ids, pixels)
        made.append((keyframe, ids))
    return made


def inverse_similarity(S: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverse (4, 4) of a similarity (4, 4)."""
    return np.asarray(np.linalg.inv(S), dtype=np.float64)
