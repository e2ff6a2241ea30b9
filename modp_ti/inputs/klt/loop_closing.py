"""Loop closing: a place that is recognised corrects the drift since it was seen, while tracking goes on."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from fields.geometry.similarity import scale_of
from modp_ti.inputs.klt.landmark_map import LandmarkMap
from modp_ti.inputs.klt.loop_detection import YOUNGEST, LoopDetection
from modp_ti.inputs.klt.map_connection import connected
from modp_ti.inputs.klt.pose_graph import Link, closed_loop
from modp_ti.inputs.klt.recognition import Recognition
from modp_ti.inputs.klt.tracking import Tracking

__all__ = ["LoopClosing", "closed_map"]

EVERY = 5  # new keyframes that are compared together, at least
# A search is given EVERY keyframes of time, and one for each GROWTH keyframes of the map, whose adjustment takes longer
# the larger the map is.
GROWTH = 20
NEAR_SHARED = 60  # landmarks that keyframes share whose relation a loop preserves


@dataclass(frozen=True)
class _Search:
    """A search for a loop that is in progress.

    Attributes:
        tracking: The tracking whose map is searched.
        copy: A copy of the map.
        due: Number of keyframes at which the result is taken.
        result: The copy after it was adjusted, or None without a loop; and whether a loop was found.
    """

    tracking: Tracking
    copy: LandmarkMap
    due: int
    result: Future[tuple[LandmarkMap | None, bool]]


class LoopClosing:
    """Closes the loops of a map while it grows.

    A thread searches a copy of the map. If there is a loop, it adjusts the copy, and the map then moves like that.

    Args:
        seed: Seed of RANSAC.
        waits: Whether the result of a search is taken at a certain keyframe, even if tracking has to wait for it, so
            that results can be reproduced. Otherwise it is taken at the first keyframe at which it is there.

    Attributes:
        closed: Number of loops that were closed.
        undone: Number of loops that were not closed because the adjusted map contradicted them.
    """

    def __init__(self, seed: int, waits: bool = True) -> None:
        self.closed = self.undone = 0
        self._waits = waits
        self._detection = LoopDetection(seed)
        self._thread = ThreadPoolExecutor(1, "loops")
        self._search: _Search | None = None
        self._tracking: Tracking | None = None
        self._since = 0  # the first keyframe that has not been compared

    def at_keyframe(self, tracking: Tracking) -> None:
        """Take the result of a search that is due, and begin the next one. The last frame is a keyframe."""
        search, count = self._search, len(tracking.map.keyframes)
        if search is not None:
            waits = search.tracking is tracking and count < search.due if self._waits else not search.result.done()
            if waits:
                return
            self._take(search, tracking)
        if tracking is not self._tracking:
            self._tracking, self._since = tracking, count - 1
            self._thread.submit(self._detection.begin_anew)
        if count - max(self._since, YOUNGEST + 1) >= EVERY:
            self._begin(tracking)

    def begin_anew(self) -> None:
        """Drop a search in progress, because its map has been joined with another one."""
        self._tracking = None

    def finish(self, tracking: Tracking) -> None:
        """Search the last keyframes too. There are no more frames."""
        if self._search is not None:
            self._take(self._search, tracking)
        if tracking is self._tracking and self._since < len(tracking.map.keyframes):
            self._take(self._begin(tracking), tracking)
        self._thread.shutdown()

    def _begin(self, tracking: Tracking) -> _Search:
        copy, since = tracking.map.copy(), self._since
        self._since = count = len(copy.keyframes)
        result = self._thread.submit(self._searched, copy, since)
        self._search = _Search(tracking, copy, count + EVERY + count // GROWTH, result)
        return self._search

    def _searched(self, landmarks: LandmarkMap, since: int) -> tuple[LandmarkMap | None, bool]:
        """What the thread does."""
        found = self._detection.search(landmarks, since)
        return (closed_map(landmarks, found), True) if found else (None, False)

    def _take(self, search: _Search, tracking: Tracking) -> None:
        """Wait for the result of a search and take it, unless the map has been joined or has another camera since."""
        self._search = None
        after, found = search.result.result()
        if search.tracking is not tracking or self._tracking is not tracking:
            self._tracking = None
            return
        for keyframe, copy in zip(tracking.map.keyframes, search.copy.keyframes, strict=False):
            if keyframe.described is None and copy.described is not None:
                keyframe.described, keyframe.described_ids = copy.described, np.full_like(copy.described_ids, -1)
        if tracking.map.lens is not search.copy.lens:
            return
        if after is not None:
            tracking.revise(search.copy, after)
            self.closed += 1
        elif found:
            self.undone += 1


def closed_map(landmarks: LandmarkMap, found: Sequence[Recognition]) -> LandmarkMap | None:
    """Close a loop in a copy of a map.

    Args:
        landmarks: The map.
        found: Recognitions that agree.

    Returns:
        The adjusted copy; None if it contradicts the loop.
    """
    place = {keyframe.number: k for k, keyframe in enumerate(landmarks.keyframes)}
    links = [Link(place[each.of.number], place[each.by.number], _relation(each)) for each in found]
    depth = float(np.median([each.depth for each in found]))
    poses = [keyframe.T_camera_world for keyframe in landmarks.keyframes]
    after = landmarks.copy()
    after.move(closed_loop(poses, connected_keyframes(landmarks), links, depth))
    return after if connected(after, found, apart=True) else None


def connected_keyframes(landmarks: LandmarkMap) -> list[tuple[int, int]]:
    """Pairs of keyframes that follow each other or share at least NEAR_SHARED landmarks."""
    of, ids, _ = landmarks.observations(range(len(landmarks.keyframes)))
    _, column = np.unique(ids, return_inverse=True)
    seen = np.zeros((len(landmarks.keyframes), int(column.max(initial=-1)) + 1), np.float32)
    seen[of, column] = 1.0
    shared = seen @ seen.T
    pairs = np.argwhere(np.triu(shared >= NEAR_SHARED, 2)).tolist()
    return [*((k, k + 1) for k in range(len(seen) - 1)), *((int(a), int(b)) for a, b in pairs)]


def _relation(found: Recognition) -> NDArray[np.float64]:
    """Similarity (4, 4) from the camera frame of `by`, in the scale around it, to that of `of`."""
    s = float(scale_of(found.S_of_by))
    return found.of.T_camera_world @ inverse_se3(found.T_camera_world) @ np.diag([s, s, s, 1.0])
