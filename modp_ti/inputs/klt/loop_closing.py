"""Loop closing: a keyframe that shows a place which the map has, but not where the map says, corrects the drift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from fields.geometry.similarity import scale_of
from modp_ti.inputs.klt.landmark_map import LandmarkMap
from modp_ti.inputs.klt.map_joining import connect
from modp_ti.inputs.klt.place_recognition import PlaceIndex
from modp_ti.inputs.klt.pose_graph import Link, closed_loop
from modp_ti.inputs.klt.recognition import Recognition, agreeing, recognised
from modp_ti.inputs.klt.tracking import Tracking

__all__ = ["LoopClosing"]

YOUNGEST = 15  # keyframes between the two ends of a loop, at least
SHARED = 10  # landmarks: keyframes that share more are connected
NOTABLE = 5.0  # px: with less drift, the search for landmarks finds those of the other end
CANDIDATES = 2  # keyframes with which a keyframe is compared
# Cosine of the image descriptors from which keyframes are compared. It is 0.1 to 0.8 for overlapping pictures of
# redkitchen, and below 0.07 for others.
LEAST_LIKENESS = 0.05
AGREEING = 3  # keyframes that must agree
REMEMBERED = 12  # keyframes for which a recognition counts
PAUSE = 5  # keyframes after a loop in which none is sought
NEAR_SHARED = 60  # landmarks that keyframes share whose relation a loop preserves
# A loop is undone if the adjusted map contradicts more of the connected observations, or of those from before.
LARGEST_LOSS, LARGEST_DAMAGE = 0.5, 0.08


class LoopClosing:
    """Closes the loops of a map while it grows.

    Args:
        index: Finds keyframes that look alike.
        seed: Seed of RANSAC.

    Attributes:
        closed: Number of loops that were closed.
        undone: Number of loops that were undone because the adjusted map contradicted them.
    """

    def __init__(self, index: PlaceIndex, seed: int) -> None:
        self.closed = self.undone = 0
        self._index = index
        self._seed = seed
        self._found: list[tuple[int, Recognition]] = []  # with the number of keyframes by then
        self._pause_until = 0
        self._of: Tracking | None = None  # the tracking of the recognitions

    def attempt(self, tracking: Tracking) -> bool:
        """Compare the last keyframe with older ones that it shares no landmarks with, and close a loop.

        Returns:
            Whether a loop was closed.
        """
        landmarks = tracking.map
        count = len(landmarks.keyframes)
        if tracking is not self._of:
            self._of, self._pause_until = tracking, 0
            self._found.clear()
        if count < max(self._pause_until, YOUNGEST + 2):
            return False
        by = landmarks.keyframes[-1]
        seen = np.zeros(len(landmarks.known), dtype=bool)
        seen[by.ids[landmarks.known[by.ids]]] = True
        old = [each for each in landmarks.keyframes[:-YOUNGEST] if seen[each.ids].sum() < SHARED]
        if not old:
            return False
        likeness = self._index.likeness(by, old)
        self._found = [each for each in self._found if count - each[0] <= REMEMBERED]
        for at in np.argsort(-likeness, kind="stable")[:CANDIDATES]:
            if likeness[at] < LEAST_LIKENESS:
                break
            found = recognised(landmarks, old[at], landmarks, by, self._seed)
            if found is None or _offset(found) * landmarks.lens.focal < NOTABLE:
                continue
            self._found.append((count, found))
            same = agreeing([each for _, each in self._found], found)
            if len({each.by.number for each in same}) >= AGREEING:
                self._found.clear()
                self._pause_until = count + PAUSE
                return self.close(tracking, same)
        return False

    def close(self, tracking: Tracking, found: Sequence[Recognition]) -> bool:
        """Close a loop, and undo that if the adjusted map contradicts it.

        Args:
            tracking: The tracking, whose last frame is the last keyframe.
            found: Recognitions that agree.

        Returns:
            Whether the loop is closed.
        """
        landmarks, motion = tracking.map, tracking.motion
        before = landmarks.state()
        place = {keyframe.number: k for k, keyframe in enumerate(landmarks.keyframes)}
        links = [Link(place[each.of.number], place[each.by.number], _relation(each)) for each in found]
        depth = float(np.median([each.depth for each in found]))
        poses = [keyframe.T_camera_world for keyframe in landmarks.keyframes]
        tracking.move(closed_loop(poses, connected_keyframes(landmarks), links, depth))
        observed = sum(len(keyframe.ids) for keyframe in landmarks.keyframes)
        made = connect(landmarks, found)
        tracking.settle()
        kept = sum(int(np.isin(ids, keyframe.ids).sum()) for keyframe, ids in made)
        remaining = sum(len(keyframe.ids) for keyframe in landmarks.keyframes) - kept
        loss = 1.0 - kept / max(1, sum(len(ids) for _, ids in made))
        if loss > LARGEST_LOSS or remaining < (1.0 - LARGEST_DAMAGE) * observed:
            landmarks.restore(before)
            tracking.motion = motion
            self.undone += 1
            return False
        self.closed += 1
        return True


def connected_keyframes(landmarks: LandmarkMap) -> list[tuple[int, int]]:
    """Pairs of keyframes that follow each other or share at least NEAR_SHARED landmarks."""
    of, ids, _ = landmarks.observations(range(len(landmarks.keyframes)))
    _, column = np.unique(ids, return_inverse=True)
    seen = np.zeros((len(landmarks.keyframes), int(column.max(initial=-1)) + 1), np.float32)
    seen[of, column] = 1.0
    shared = seen @ seen.T
    pairs = np.argwhere(np.triu(shared >= NEAR_SHARED, 2)).tolist()
    return [*((k, k + 1) for k in range(len(seen) - 1)), *((int(a), int(b)) for a, b in pairs)]


def _offset(found: Recognition) -> float:
    """Approximate motion of the picture, in focal lengths, from where the map has `by` to where it was recognised."""
    off = found.T_camera_world @ inverse_se3(found.by.T_camera_world)
    turn = float(np.arccos(np.clip((np.trace(off[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
    return turn + float(np.linalg.norm(off[:3, 3])) / found.depth


def _relation(found: Recognition) -> NDArray[np.float64]:
    """Similarity (4, 4) from the camera frame of `by`, in the scale around it, to that of `of`."""
    s = float(scale_of(found.S_of_by))
    return found.of.T_camera_world @ inverse_se3(found.T_camera_world) @ np.diag([s, s, s, 1.0])
