"""Connection of the keyframes of a map that recognise each other, and the check that the map agrees with it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.klt.frame import LocalisedFrame
from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap
from modp_ti.inputs.klt.localisation import searched
from modp_ti.inputs.klt.recognition import Recognition
from modp_ti.inputs.klt.relocalisation import described_keyframe, inherited

__all__ = ["connected"]

ROUNDS = 2  # bundle adjustments, each without the outliers of the one before
# The map contradicts a connection if the residuals of more of the connecting observations, or of the others, are those
# of outliers after the adjustment.
LARGEST_LOSS, LARGEST_DAMAGE = 0.5, 0.04


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
    observed = _observations(landmarks)
    made = connect(landmarks, found)
    for _ in range(ROUNDS):
        if not np.isfinite(landmarks.adjust(every, steps=10, apart=apart)):
            return False
        landmarks.discard_outliers(every)
    kept = sum(int(np.isin(ids, keyframe.ids).sum()) for keyframe, ids in made)
    total = sum(len(ids) for _, ids in made)
    agree = total > 0 and kept >= (1.0 - LARGEST_LOSS) * total
    return agree and _observations(landmarks) - kept >= (1.0 - LARGEST_DAMAGE) * observed


def connect(landmarks: LandmarkMap, found: Sequence[Recognition]) -> list[tuple[Keyframe, NDArray[np.int64]]]:
    """Let keyframes observe the landmarks of the keyframes that they recognise.

    Returns:
        The keyframes with the ids (N,) of the landmarks that they observe now.
    """
    place = {keyframe.number: k for k, keyframe in enumerate(landmarks.keyframes)}
    made = []
    for each in found:
        of, by = place[each.of.number], place[each.by.number]
        keyframe = landmarks.keyframes[by]
        T = keyframe.T_camera_world
        frame = LocalisedFrame(keyframe.number, keyframe.grey, None, keyframe.ids, keyframe.pixels, T_camera_world=T)
        before = len(frame.ids)
        frame.append(*inherited(landmarks, of, described_keyframe(keyframe), each.pairs, T))
        frame.append(*searched(landmarks, frame))
        ids, pixels = frame.ids[before:], frame.pixels[before:]
        keyframe.append(ids, pixels, landmarks.lens.rays(pixels))
        landmarks.note_observations(by, ids, pixels)
        made.append((keyframe, ids[landmarks.known[ids]]))
    return made


def _observations(landmarks: LandmarkMap) -> int:
    return sum(int(landmarks.known[keyframe.ids].sum()) for keyframe in landmarks.keyframes)
