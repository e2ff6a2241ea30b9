"""Loop closing: a place that is recognised corrects the drift since it was seen, while tracking goes on."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3, motion_around, scale_of
from modp_ti.inputs.klt.landmark_map import LANDMARKS, LandmarkMap
from modp_ti.inputs.klt.map_connection import connected
from modp_ti.inputs.klt.recognition import PlaceIndex, Recognition, agreeing, recognised
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
AGREEING = 3  # keyframes that must agree
REMEMBERED = 12  # keyframes for which a recognition counts
PAUSE = 5  # keyframes after a loop in which none is sought
STEPS = 50  # of the pose graph
# Uncertainties of a link in rotation [radians], place (relative to the scene's depth) and scale. Only their ratios
# matter.
SIGMA = 0.01


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
            tracking.follow_moves(carry_over(tracking.map, search.copy, after))
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


@dataclass(frozen=True)
class Link:
    """A measured relation of two keyframes.

    Attributes:
        a: Index of the one keyframe.
        b: Index of the other.
        T_a_b: (4, 4) similarity from the camera frame of b, in the scale around it, to that of a.
    """

    a: int
    b: int
    T_a_b: NDArray[np.float64]


def solver_is_there() -> bool:
    """Whether gtsam, which has no wheel for some platforms, is installed."""
    try:
        import gtsam  # noqa: F401
    except ImportError:
        return False
    return True


def closed_loop(
    poses: Sequence[NDArray[np.float64]], near: Sequence[tuple[int, int]], loops: Sequence[Link], depth: float
) -> list[NDArray[np.float64]]:
    """Find the similarities by which keyframes move so that loops close.

    Args:
        poses: T_camera_world (4, 4) of the keyframes. The first one stays.
        near: Pairs of keyframes whose relation shall stay as it is.
        loops: Relations that recognised places tell.
        depth: Typical depth of the scene.

    Returns:
        S_after_before (4, 4) of the world around each keyframe.
    """
    import gtsam

    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    cameras = [inverse_se3(T) for T in poses]

    def similarity(matrix: NDArray[np.float64]) -> gtsam.Similarity3:
        s = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        return gtsam.Similarity3(matrix[:3, :3] / s, matrix[:3, 3] / (s * depth), s)  # acts as s (R x + t)

    noise = gtsam.noiseModel.Isotropic.Sigma(7, SIGMA)
    for i, camera in enumerate(cameras):
        start.insert(i, similarity(camera))
    graph.add(gtsam.PriorFactorSimilarity3(0, similarity(cameras[0]), gtsam.noiseModel.Isotropic.Sigma(7, 1e-6)))
    for a, b in near:
        graph.add(gtsam.BetweenFactorSimilarity3(a, b, similarity(poses[a] @ cameras[b]), noise))
    for link in loops:
        graph.add(gtsam.BetweenFactorSimilarity3(link.a, link.b, similarity(link.T_a_b), noise))
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
        keyframe.append(ids, pixels, new.rays[made])
        landmarks.note_observations(k, ids, pixels)
        if new.described is None:
            continue
        if keyframe.described is None:
            keyframe.described, keyframe.described_ids = new.described, np.full_like(new.described_ids, -1)
        given = (new.described_ids >= 0) & (keyframe.described_ids < 0)
        keyframe.described_ids[given] = id_of[new.described_ids[given]]
