"""Tracking of a rig of cameras, such as the faces of a panorama: one pose for the views of a time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3, orthonormalised
from modp_ti.inputs.klt.frame import Frame, LocalisedFrame, corners
from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap
from modp_ti.inputs.klt.localisation import FEWEST, MAX_ERROR, SIGMA, predicted_pixels, realigned, searched
from modp_ti.inputs.klt.recognition import place_by_features
from modp_ti.inputs.klt.tracking import EAGER, KEYFRAME_SHARE, KEYFRAME_SHIFT, LAZY, View
from modp_ti.inputs.multiview.rig_pose import refine_rig_pose, rig_errors, rig_pose_from_points

__all__ = ["RigTracking", "localised_rig", "replenished"]

WANTED = 900  # features that are tracked in all views together
WINDOW = 6  # free places of a bundle adjustment
HELD = 6  # fixed places of a bundle adjustment, at most
COMMON = 30  # landmarks that a fixed place shares with the free ones, at least


def localised_rig(
    landmarks: LandmarkMap, frames: Sequence[Frame], T_rig_world: NDArray[np.float64], seed: int
) -> list[LocalisedFrame] | None:
    """Localise the views of a time by their features.

    Args:
        landmarks: The map of a rig.
        frames: The C views.
        T_rig_world: (4, 4) initial pose of the rig.
        seed: Seed of RANSAC, which runs if too few landmarks agree with the refined initial pose.

    Returns:
        The views with their poses, and without the features that do not agree; None if too few landmarks agree.
    """
    mounts, lens = landmarks.mounts, landmarks.lens
    assert mounts is not None
    known = [landmarks.known[frame.ids] for frame in frames]
    camera = np.repeat(np.arange(len(frames)), [int(each.sum()) for each in known])
    if len(camera) < FEWEST:
        return None
    xyz = landmarks.xyz[np.concatenate([frame.ids[each] for frame, each in zip(frames, known, strict=True)])]
    rays = np.concatenate([lens.rays(frame.pixels[each]) for frame, each in zip(frames, known, strict=True)])

    def refined(T: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        T = refine_rig_pose(T, mounts, camera, xyz, rays, SIGMA / lens.focal)
        return T, rig_errors(T, mounts, camera, xyz, rays) * lens.focal < MAX_ERROR

    T, good = refined(T_rig_world)
    if good.sum() < 0.7 * len(good):
        found = rig_pose_from_points(mounts, camera, xyz, rays, MAX_ERROR / lens.focal, seed)
        if found is not None:
            other, agreeing = refined(found)
            if agreeing.sum() > good.sum():
                T, good = other, agreeing
    if good.sum() < max(FEWEST, 0.3 * len(good)):
        return None
    result = []
    for number, (frame, each) in enumerate(zip(frames, known, strict=True)):
        kept = np.ones(len(frame.ids), dtype=bool)
        kept[each] = good[camera == number]
        pose = orthonormalised(mounts[number] @ T)
        result.append(
            LocalisedFrame(
                frame.number, frame.grey, frame.valid, frame.ids[kept], frame.pixels[kept], T_camera_world=pose
            )
        )
    return result


def replenished(frame: Frame, views: int) -> NDArray[np.float64]:
    """Corners (N, 2) away from the features of one of the views, which then has its share of all features."""
    return corners(frame.grey, frame.pixels, WANTED // views, frame.valid)


class RigTracking:
    """Localises a rig from its last keyframes on, and adds keyframes of all its views to the map.

    Args:
        landmarks: The initial map of the rig, whose last keyframes are those of `last`.
        last: The views of the last keyframes.
        seed: Seed of RANSAC.

    Attributes:
        map: The map.
        recovered: Number of places that were found again after the track was lost.
    """

    camera_is_final = True

    def __init__(self, landmarks: LandmarkMap, last: Sequence[Frame], seed: int) -> None:
        assert landmarks.mounts is not None
        self.map = landmarks
        self.recovered = 0
        self._mounts = landmarks.mounts
        self._seed = seed
        self._motion = np.eye(4)  # of the rig, from the time before to the last one
        self._lost_for = 0
        self._last = [
            LocalisedFrame(
                frame.number, frame.grey, frame.valid, each.ids, each.pixels, T_camera_world=each.T_camera_world
            )
            for frame, each in zip(last, self._newest(), strict=True)
        ]
        self._replenish(self._last)

    def pose(self, view: View) -> NDArray[np.float64]:
        """T_camera_world (4, 4) of a view in the current map."""
        return view.T_camera_world

    def track(self, frames: Sequence[Frame]) -> list[View]:
        """Localise the next views, which may become keyframes. Empty if that fails."""
        if self._lost_for:
            self._lost_for += 1
            if self._lost_for > EAGER and self._lost_for % LAZY:
                return []
            found = self._recovered(frames, self._candidates(frames))
            self.recovered += len(found) > 0
            return found
        last, T_last = self._last, self._rig_pose(self._last)
        for T in (orthonormalised(self._motion @ T_last), T_last):  # the prediction, and without it
            for frame, before, mount in zip(frames, last, self._mounts, strict=True):
                frame.track(before, predicted_pixels(self.map, before, mount @ T))
            located = localised_rig(self.map, frames, T, self._seed)
            if located is not None:
                self._motion = self._rig_pose(located) @ inverse_se3(T_last)
                self._last = located
                return self._make_keyframes(located) if self._wants_keyframes(located) else self.views(located)
        found = self._recovered(frames, [len(self.map.keyframes) // len(frames) - 1])
        self._lost_for = 0 if found else 1
        return found

    def views(self, frames: Sequence[LocalisedFrame]) -> list[View]:
        """The views of a time relative to the last keyframes before it, or to the first ones."""
        count, keyframes = len(frames), self.map.keyframes
        earlier = sum(keyframe.number <= frames[0].number for keyframe in keyframes[::count])
        result = []
        for frame, keyframe in zip(frames, keyframes[max(0, earlier - 1) * count :], strict=False):
            T, known = frame.T_camera_world @ inverse_se3(keyframe.T_camera_world), self.map.known[frame.ids]
            result.append(View(frame.number, keyframe, T, frame.ids[known], frame.pixels[known], keyframe.scale))
        return result

    # ---- keyframes -------------------------------------------------------------------------------------------

    def _newest(self) -> list[Keyframe]:
        return self.map.keyframes[-len(self._mounts) :]

    def _rig_pose(self, frames: Sequence[LocalisedFrame]) -> NDArray[np.float64]:
        return inverse_se3(self._mounts[0]) @ frames[0].T_camera_world

    def _wants_keyframes(self, frames: Sequence[LocalisedFrame]) -> bool:
        moved, seen, known = [], 0, 0
        for frame, keyframe in zip(frames, self._newest(), strict=True):
            common, a, b = np.intersect1d(keyframe.ids, frame.ids, return_indices=True)
            moved.append(np.linalg.norm(keyframe.pixels[a] - frame.pixels[b], axis=1))
            seen, known = seen + self.map.known[common].sum(), known + self.map.known[keyframe.ids].sum()
        shift = np.concatenate(moved)
        if len(shift) < FEWEST or seen < KEYFRAME_SHARE * known:
            return True
        return float(np.median(shift)) > KEYFRAME_SHIFT * max(frames[0].grey.shape)

    def _make_keyframes(self, frames: list[LocalisedFrame]) -> list[View]:
        """Make the views of the last time keyframes: realign their landmarks, search for more, and adjust the map."""
        for frame in frames:
            frame.pixels = realigned(self.map, frame)
        self._search(frames)
        frames = localised_rig(self.map, frames, self._rig_pose(frames), self._seed) or frames
        lens, first = self.map.lens, len(self.map.keyframes)
        for frame in frames:
            rays = lens.rays(frame.pixels)
            keyframe = Keyframe(frame.number, frame.T_camera_world, frame.grey, frame.ids, frame.pixels, rays)
            self.map.add_keyframe(keyframe)
        self._replenish(frames)
        for k in range(first, first + len(frames)):
            self.map.triangulate(k)
        self._adjust()
        for frame, keyframe in zip(frames, self._newest(), strict=True):
            frame.T_camera_world = keyframe.T_camera_world.copy()
            still = np.isin(frame.ids, keyframe.ids)
            frame.ids, frame.pixels = frame.ids[still], frame.pixels[still]
        self._last = frames
        return self.views(frames)

    def _search(self, frames: Sequence[LocalisedFrame]) -> None:
        """Add further landmarks of the map to the views, each to one of them."""
        for frame in frames:
            frame.append(*searched(self.map, frame, np.concatenate([each.ids for each in frames])))

    def _replenish(self, frames: Sequence[Frame]) -> None:
        """Detect new corners in the views of the last keyframes, and add them to both."""
        first = len(self.map.keyframes) - len(frames)
        for k, frame in enumerate(frames, first):
            new = replenished(frame, len(frames))
            ids = self.map.new_ids(len(new))
            self.map.keyframes[k].append(ids, new, self.map.lens.rays(new))
            self.map.note_observations(k, ids, new)
            frame.append(ids, new)

    def _adjust(self) -> None:
        """Bundle adjust the last places, with those that share the most landmarks with them held."""
        count = len(self._mounts)
        places = len(self.map.keyframes) // count
        free = list(range(max(0, places - WINDOW), places))
        seen = np.zeros(len(self.map.known), dtype=bool)
        seen[self.map.observations(self._views_at(free))[1]] = True
        shared = {
            place: sum(int(seen[self.map.keyframes[k].ids].sum()) for k in self._views_at([place]))
            for place in range(free[0])
        }
        closest = sorted(shared, key=lambda place: (-shared[place], -place))[:HELD]
        held = [place for place in closest if shared[place] >= COMMON]
        if not held:
            held, free = free[:2], free[2:]
        self.map.adjust(self._views_at(free), self._views_at(held), steps=8)
        self.map.discard_outliers(self._views_at(free))

    def _views_at(self, places: Iterable[int]) -> list[int]:
        """Indices of the keyframes at places of the rig."""
        count = len(self._mounts)
        return [place * count + number for place in places for number in range(count)]

    # ---- gaps ------------------------------------------------------------------------------------------------

    def _candidates(self, frames: Sequence[Frame]) -> list[int]:
        """The last place, and some that are spread over the others, which another attempt compares with others."""
        last = len(self.map.keyframes) // len(frames) - 1
        return [last, *range(self._lost_for % 4, last, max(4, last // 4))]

    def _recovered(self, frames: Sequence[Frame], places: Iterable[int]) -> list[View]:
        """Localise the views by SIFT matches of any of them with a keyframe at these places; they become keyframes."""
        for frame in frames:
            frame.ids, frame.pixels = frame.ids[:0], frame.pixels[:0]
        for k in self._views_at(places):
            for frame, mount in zip(frames, self._mounts, strict=True):
                placed = place_by_features(self.map, self.map.keyframes[k], frame.described, self._seed)
                if placed is None:
                    continue
                T = inverse_se3(mount) @ placed[0]
                located = [
                    LocalisedFrame(each.number, each.grey, each.valid, T_camera_world=orthonormalised(own @ T))
                    for each, own in zip(frames, self._mounts, strict=True)
                ]
                self._search(located)
                located = localised_rig(self.map, located, T, self._seed)
                if located is not None:
                    self._motion, self._lost_for = np.eye(4), 0
                    return self._make_keyframes(located)
        return []
