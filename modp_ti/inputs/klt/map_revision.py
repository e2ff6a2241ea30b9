"""Revision of a map by the adjustment of an earlier copy of it, while which the map has grown."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.geometry.similarity import motion_around
from modp_ti.inputs.klt.landmark_map import LANDMARKS, LandmarkMap

__all__ = ["carry_over"]


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
