"""Loop closing: a place that is recognised corrects the drift since it was seen, while tracking goes on."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3, motion_around, scale_of
from modp_ti.inputs.klt.landmark_map import LANDMARKS, LandmarkMap
from modp_ti.inputs.klt.map_joining import connected
from modp_ti.inputs.klt.recognition import (
    AGREEING,
    PAUSE,
    PlaceIndex,
    Recognition,
    agreeing,
    recognised,
    turn_and_shift,
)
from modp_ti.inputs.klt.tracking import Tracking

EVERY = 5  # new keyframes that are compared together, at least
# A search is given EVERY keyframes of time, and one for each GROWTH keyframes of the map, whose adjustment takes longer
# the larger the map is.
GROWTH = 20
NEAR_SHARED = 60  # landmarks that keyframes share whose relation a loop preserves
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
REMEMBERED = 12  # keyframes for which a recognition counts
STEPS = 50  # of the pose graph
# Uncertainties of a link in rotation [radians], place (relative to the scene's depth) and scale. Only their ratios
# matter.
SIGMA = 0.01


Link = tuple[int, int, NDArray[np.float64]]
"""Indices a and b of two keyframes, and the similarity T_a_b (4, 4) from the camera frame of b to that of a."""


@dataclass(frozen=True)
class _Search:
    """A search for a loop in a copy of a map, which is due at a number of keyframes.

    Its result is the copy after it was adjusted, or None without a loop; and whether a loop was found.
    """

    tracking: Tracking
    copy: LandmarkMap
    due: int
    result: Future[tuple[LandmarkMap | None, bool]]


class LoopClosing:
    """Closes the loops of a map while it grows.

    A thread searches a copy of the map. If there is a loop, it adjusts the copy, and the map then moves like that.

    Args:
        seed: Seed of RANSAC and of the vocabulary.
        waits: Whether the result of a search is taken at a certain keyframe, even if tracking has to wait for it, so
            that results can be reproduced. Otherwise it is taken at the first keyframe at which it is there.

    Attributes:
        closed: Number of loops that were closed.
        undone: Number of loops that were not closed because the adjusted map contradicted them.
    """

    def __init__(self, seed: int, waits: bool = True) -> None:
        self.closed = self.undone = 0
        self._waits = waits
        self._seed = seed
        self._thread = ThreadPoolExecutor(1, "loops")
        self._search: _Search | None = None
        self._tracking: Tracking | None = None
        self._since = 0  # the first keyframe that has not been compared
        # Of the thread alone: the recognitions with the index of their keyframe, and until which none is sought.
        self._index = PlaceIndex(seed)
        self._found: list[tuple[int, Recognition]] = []
        self._pause_until = 0

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
            self._thread.submit(self._forget)  # keyframes will have other indices
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

    def _forget(self) -> None:
        self._found.clear()
        self._pause_until = 0

    def _searched(self, landmarks: LandmarkMap, since: int) -> tuple[LandmarkMap | None, bool]:
        """What the thread does: close a loop in a copy of the map; None if there is none or the map contradicts it."""
        found = self._loop(landmarks, since)
        if not found:
            return None, False
        after = landmarks.copy()
        index, poses = landmarks.index, [keyframe.T_camera_world for keyframe in landmarks.keyframes]
        links = []
        for each in found:  # from the camera of `by`, in the scale around it, to that of `of`
            s = float(scale_of(each.S_of_by))
            T_of_by = each.of.T_camera_world @ inverse_se3(each.T_camera_world) @ np.diag([s, s, s, 1.0])
            links.append((index(each.of.number), index(each.by.number), T_of_by))
        depth = float(np.median([each.depth for each in found]))
        after.move(closed_loop(poses, _connected_keyframes(landmarks), links, depth))
        return after if connected(after, found, apart=True) else None, True

    def _loop(self, landmarks: LandmarkMap, since: int) -> list[Recognition]:
        """Compare new keyframes, from index `since` on, with older ones that they share no landmarks with.

        Returns recognitions of AGREEING keyframes at least that agree on where they are; none without a loop.
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
        candidates = self._index.alike(by, old, CANDIDATES, LEAST_LIKENESS)
        if old:
            self._found = [each for each in self._found if k - each[0] <= REMEMBERED]
        best: list[Recognition] = []
        for at in candidates:
            found = recognised(landmarks, old[at], landmarks, by, self._seed)
            if found is None:
                continue
            # Relative to the scene's depth. The sum is about the motion of the picture, in focal lengths.
            turn, shift = turn_and_shift(found.T_camera_world, found.by.T_camera_world)
            if turn > LARGEST_TURN or (turn + shift / found.depth) * landmarks.lens.focal < NOTABLE:
                continue
            self._found.append((k, found))
            best = max(best, agreeing([each for _, each in self._found], found), key=len)
        return best

    def _take(self, search: _Search, tracking: Tracking) -> None:
        """Wait for the result of a search and take it, unless the map has been joined or has another camera since."""
        self._search = None
        after, found = search.result.result()
        if search.tracking is not tracking or self._tracking is not tracking:
            self._tracking = None
            return
        for keyframe, copy in zip(tracking.map.keyframes, search.copy.keyframes, strict=False):
            if keyframe.features is None and copy.features is not None:
                keyframe.features, keyframe.described_ids = copy.features, np.full_like(copy.described_ids, -1)
        if tracking.map.lens is not search.copy.lens:
            return
        if after is not None:
            tracking.follow_moves(carry_over(tracking.map, search.copy, after))
            self.closed += 1
        elif found:
            self.undone += 1


def _connected_keyframes(landmarks: LandmarkMap) -> list[tuple[int, int]]:
    """Pairs of keyframes that follow each other or share at least NEAR_SHARED landmarks."""
    of, ids, _ = landmarks.observations(range(len(landmarks.keyframes)))
    _, column = np.unique(ids, return_inverse=True)
    seen = np.zeros((len(landmarks.keyframes), int(column.max(initial=-1)) + 1), np.float32)
    seen[of, column] = 1.0
    shared = seen @ seen.T
    pairs = np.argwhere(np.triu(shared >= NEAR_SHARED, 2)).tolist()
    return [*((k, k + 1) for k in range(len(seen) - 1)), *((int(a), int(b)) for a, b in pairs)]


def closed_loop(
    poses: Sequence[NDArray[np.float64]], near: Sequence[tuple[int, int]], loops: Sequence[Link], depth: float
) -> list[NDArray[np.float64]]:
    """Find the similarities by which keyframes move so that loops close.

    Args:
        poses: T_camera_world (4, 4) of the keyframes. The first one stays.
        near: Pairs of keyframes whose relation shall stay as it is.
        loops: Relations by recognised places, in the scale around each keyframe.
        depth: Typical depth of the scene.

    Returns:
        S_after_before (4, 4) of the world around each keyframe.
    """
    import gtsam

    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    cameras = [inverse_se3(T) for T in poses]

    def similarity(matrix: NDArray[np.float64]) -> gtsam.Similarity3:
        s = float(scale_of(matrix))
        return gtsam.Similarity3(matrix[:3, :3] / s, matrix[:3, 3] / (s * depth), s)  # acts as s (R x + t)

    noise = gtsam.noiseModel.Isotropic.Sigma(7, SIGMA)
    for i, camera in enumerate(cameras):
        start.insert(i, similarity(camera))
    graph.add(gtsam.PriorFactorSimilarity3(0, similarity(cameras[0]), gtsam.noiseModel.Isotropic.Sigma(7, 1e-6)))
    for a, b in near:
        graph.add(gtsam.BetweenFactorSimilarity3(a, b, similarity(poses[a] @ cameras[b]), noise))
    for a, b, T_a_b in loops:
        graph.add(gtsam.BetweenFactorSimilarity3(a, b, similarity(T_a_b), noise))
    options = gtsam.LevenbergMarquardtParams()
    options.setMaxIterations(STEPS)
    result = gtsam.LevenbergMarquardtOptimizer(graph, start, options).optimize()
    moves = []
    for i, T in enumerate(poses):
        found = result.atSimilarity3(i)
        after, s = np.eye(4), float(found.scale())
        after[:3, :3] = s * found.rotation().matrix()
        after[:3, 3] = s * depth * np.asarray(found.translation())
        moves.append(after @ T)
    return moves


def carry_over(landmarks: LandmarkMap, before: LandmarkMap, after: LandmarkMap) -> list[NDArray[np.float64]]:
    """Move a map as the adjustment moved its copy, and take over the new observations.

    What has not changed since the copy was made becomes what it is in the adjusted copy. What has changed keeps the
    difference. A newer keyframe moves with the one with which it shares the most landmarks: after the track was lost,
    that is not the one before.

    Args:
        landmarks: The map. It has the keyframes of the copy and newer ones.
        before: The copy.
        after: The copy after its adjustment.

    Returns:
        S_after_before (4, 4) of the world around each keyframe of the map.
    """
    count = len(before.keyframes)
    moves = [_move(before, after, k) for k in range(count)]
    for nearest in _nearest_of_newer(landmarks, count):
        moves.append(moves[nearest])
    old = slice(before.count)
    ids = np.flatnonzero(before.known[old] & after.known[old] & landmarks.known[old])
    since = landmarks.xyz[ids] - before.xyz[ids]
    landmarks.move(moves)
    turned = np.stack(moves)[landmarks.first[ids], :3, :3]
    landmarks.xyz[ids] = after.xyz[ids] + np.einsum("nij,nj->ni", turned, since)
    _take_observations(landmarks, before, after)
    landmarks.discard_outliers(range(len(landmarks.keyframes)))
    return moves


def _move(before: LandmarkMap, after: LandmarkMap, k: int) -> NDArray[np.float64]:
    """S_after_before (4, 4) of the world around keyframe k, whose scale is that of the depths that it sees."""
    old, new = before.keyframes[k], after.keyframes[k]
    ids = old.ids[before.known[old.ids] & after.known[old.ids]]
    z = before.xyz[ids] @ old.T_camera_world[2, :3] + old.T_camera_world[2, 3]
    z_new = after.xyz[ids] @ new.T_camera_world[2, :3] + new.T_camera_world[2, 3]
    seen = (z > 0) & (z_new > 0)
    scale = float(np.median(z_new[seen] / z[seen])) if seen.any() else new.scale / old.scale
    return motion_around(old.T_camera_world, new.T_camera_world, scale)


def _nearest_of_newer(landmarks: LandmarkMap, count: int) -> list[int]:
    """For each keyframe from index `count` on, the older keyframe that shares the most landmarks with it."""
    found = []
    for k in range(count, len(landmarks.keyframes)):
        seen = np.zeros(len(landmarks.known), dtype=bool)
        seen[landmarks.observations([k])[1]] = True
        shared = [int(seen[keyframe.ids].sum()) for keyframe in landmarks.keyframes[:k]]
        found.append(k - 1 - int(np.argmax(shared[::-1])))  # the last one of several
    return found


def _take_observations(landmarks: LandmarkMap, before: LandmarkMap, after: LandmarkMap) -> None:
    """Add the observations that `after` has more than `before`, with new ids for its new features."""
    new_ids = landmarks.new_ids(after.count - before.count)
    for name in LANDMARKS:
        getattr(landmarks, name)[new_ids] = getattr(after, name)[before.count : after.count]
    id_of = np.concatenate([np.arange(before.count), new_ids])
    for k, (old, new) in enumerate(zip(before.keyframes, after.keyframes, strict=True)):
        keyframe = landmarks.keyframes[k]
        made = ~np.isin(new.ids, old.ids) & ~np.isin(id_of[new.ids], keyframe.ids)
        ids, pixels = id_of[new.ids[made]], new.pixels[made]
        landmarks.observe(k, ids, pixels)
        if new.features is None:
            continue
        if keyframe.features is None:
            keyframe.features, keyframe.described_ids = new.features, np.full_like(new.described_ids, -1)
        given = (new.described_ids >= 0) & (keyframe.described_ids < 0)
        keyframe.described_ids[given] = id_of[new.described_ids[given]]
