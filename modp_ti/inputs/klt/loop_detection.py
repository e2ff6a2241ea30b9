"""Detection of loops: keyframes that show a place which the map has, but not where the map says."""

from __future__ import annotations

import numpy as np

from fields.geometry.se3 import inverse_se3
from modp_ti.inputs.klt.landmark_map import LandmarkMap
from modp_ti.inputs.klt.place_recognition import PlaceIndex
from modp_ti.inputs.klt.recognition import Recognition, agreeing, recognised

__all__ = ["YOUNGEST", "LoopDetection"]

YOUNGEST = 15  # keyframes between the two ends of a loop, at least
SHARED = 10  # landmarks: keyframes that share more are connected
NOTABLE = 5.0  # px: with less drift, the search for landmarks finds those of the other end
# Radians. Directions drift by a few degrees over a recording. Opposite sides of a building that look alike make turns
# of 180 degrees, which the check of the adjusted map has missed.
LARGEST_TURN = 0.8
CANDIDATES = 2  # keyframes with which a keyframe is compared
# Cosine of the image descriptors from which keyframes are compared. It is 0.1 to 0.8 for overlapping pictures of
# redkitchen, and below 0.07 for others.
LEAST_LIKENESS = 0.05
AGREEING = 3  # keyframes that must agree
REMEMBERED = 12  # keyframes for which a recognition counts
PAUSE = 5  # keyframes after a loop in which none is sought


class LoopDetection:
    """Finds the loops of a map while it grows.

    Args:
        seed: Seed of RANSAC and of the vocabulary.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._index = PlaceIndex(seed)
        self._found: list[tuple[int, Recognition]] = []  # with the index of the keyframe
        self._pause_until = 0

    def begin_anew(self) -> None:
        """Forget the recognitions, because keyframes will have other indices."""
        self._found.clear()
        self._pause_until = 0

    def search(self, landmarks: LandmarkMap, since: int) -> list[Recognition]:
        """Compare new keyframes, from index `since` on, with older ones that they share no landmarks with.

        Returns:
            Recognitions of AGREEING keyframes at least that agree on where they are; none without a loop.
        """
        for k in range(max(since, self._pause_until, YOUNGEST + 1), len(landmarks.keyframes)):
            same = self._compared(landmarks, k)
            if len({each.by.number for each in same}) >= AGREEING:
                self._found.clear()
                self._pause_until = len(landmarks.keyframes) + PAUSE
                return same
        return []

    def _compared(self, landmarks: LandmarkMap, k: int) -> list[Recognition]:
        """Compare keyframe k. Returns a notable recognition of it with those that agree; none if there is none."""
        by = landmarks.keyframes[k]
        seen = np.zeros(len(landmarks.known), dtype=bool)
        seen[by.ids[landmarks.known[by.ids]]] = True
        old = [each for each in landmarks.keyframes[: k + 1 - YOUNGEST] if seen[each.ids].sum() < SHARED]
        if not old:
            return []
        likeness = self._index.likeness(by, old)
        self._found = [each for each in self._found if k - each[0] <= REMEMBERED]
        best: list[Recognition] = []
        for at in np.argsort(-likeness, kind="stable")[:CANDIDATES]:
            if likeness[at] < LEAST_LIKENESS:
                break
            found = recognised(landmarks, old[at], landmarks, by, self._seed)
            if found is None:
                continue
            turn, shift = _offset(found)
            if turn > LARGEST_TURN or (turn + shift) * landmarks.lens.focal < NOTABLE:
                continue
            self._found.append((k, found))
            best = max(best, agreeing([each for _, each in self._found], found), key=len)
        return best


def _offset(found: Recognition) -> tuple[float, float]:
    """How far the place where `by` was recognised is from where the map has it.

    Returns:
        The turn [radians], and the shift relative to the scene's depth. Their sum is about the motion of the picture,
        in focal lengths.
    """
    off = found.T_camera_world @ inverse_se3(found.by.T_camera_world)
    turn = float(np.arccos(np.clip((np.trace(off[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
    return turn, float(np.linalg.norm(off[:3, 3])) / found.depth
