"""Poses of frames as they arrive, and the map that they make: the tracker itself, apart from files and settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3, orthonormalised
from modp_ti.inputs.klt.bundle_adjustment import adjust_bundle
from modp_ti.inputs.klt.initialisation import Initialisation, SeenFrame
from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap
from modp_ti.inputs.klt.lens import Lens
from modp_ti.inputs.klt.localisation import FEWEST, localised, realigned, searched
from modp_ti.inputs.klt.optical_flow import corners, flow
from modp_ti.inputs.klt.relocalisation import alike_keyframes, describe, inherited, place_by_features, thumbnail
from modp_ti.inputs.multiview.features import Features

__all__ = ["Odometry", "View"]

WANTED = 450  # features that are followed
# A keyframe is made where the features have moved by this share of the image's longer side since the last one, or
# where fewer than this share of its landmarks are still seen.
KEYFRAME_SHIFT = 0.05
KEYFRAME_SHARE = 0.65
WINDOW = 8  # keyframes that a bundle adjustment moves
HELD = 12  # keyframes that it holds
WIDE_EVERY = 12  # keyframes between bundle adjustments of WIDE_WINDOW of them
WIDE_WINDOW = 30
# Keyframes from which a camera that is unknown can be told: few of them fit any.
FOCAL_FROM = 6
DISTORTION_FROM = 12
REFINED_AT = (6, 12, 24, 48)
# Tries to find a lost camera: at every frame at first, then now and then.
EAGER = 10
LAZY = 5


@dataclass
class View:
    """A frame with a pose: that of its keyframe and where it is from there.

    ids, pixels: (N,), (N, 2) the landmarks seen, in the followed image.
    """

    number: int
    keyframe: int
    T_camera_keyframe: NDArray[np.float64]
    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]


@dataclass
class _State:
    """What is followed: the last image, its pose, its features."""

    number: int
    grey: NDArray[np.uint8]
    valid: NDArray[np.bool_] | None
    T: NDArray[np.float64]
    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]
    keyframe: int | None = None


@dataclass
class Counts:
    """What became of the frames."""

    lost: int = 0
    recovered: int = 0
    bridged: int = 0
    numbers_lost: list[int] = field(default_factory=list)


class Odometry:
    """Takes frames in their order and gives poses. lenses: one camera, or several of which the best is taken.

    refines: whether the camera is refined with the map, for frames whose camera is unknown.
    """

    def __init__(self, lenses: Sequence[Lens], seed: int = 0, refines: bool = False) -> None:
        self.map: LandmarkMap | None = None
        self.counts = Counts()
        self._initialisation: Initialisation | None = Initialisation(lenses, seed)
        self._refines = refines
        self._seed = seed
        self._state: _State | None = None
        self._motion = np.eye(4)
        self._thumbnails: list[NDArray[np.float32]] = []
        self._lost_for = 0

    @property
    def waiting(self) -> int:
        """Frames that were taken in and have no pose yet, because there is no map."""
        return len(self._initialisation.frames) if self._initialisation is not None else 0

    def pose(self, view: View) -> NDArray[np.float64]:
        """T_camera_world (4, 4) of a view as the map has it now."""
        return orthonormalised(view.T_camera_keyframe @ self.map.keyframes[view.keyframe].T_camera_world)

    def process(self, number: int, grey: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None) -> list[View]:
        """Views that have got a pose with this frame, in their order: none, this one, or all since the start.

        number: of the frame, increasing. grey: (H, W) uint8. valid: (H, W), False where nothing may be followed.
        """
        if self._initialisation is not None:
            found = self._initialisation.add(number, grey, valid)
            return [] if found is None else self._begin(found)
        if self._state is None:
            view = self._recover(number, grey, valid)
        else:
            view = self._follow(number, grey, valid)
        if view is None:
            self.counts.lost += 1
            self.counts.numbers_lost.append(number)
            return []
        return [view]

    # ------------------------------------------------------------------------------------------------- initialisation

    def _begin(self, landmarks: LandmarkMap) -> list[View]:
        """Poses for the frames from which the map was made, and for those before."""
        self.map = landmarks
        self._thumbnails = [thumbnail(keyframe.grey) for keyframe in landmarks.keyframes]
        frames, self._initialisation = self._initialisation.frames, None
        place = {frame.number: i for i, frame in enumerate(frames)}
        posed = {place[keyframe.number]: k for k, keyframe in enumerate(landmarks.keyframes)}
        first = min(posed)
        views: dict[int, View] = {}
        T = landmarks.keyframes[0].T_camera_world
        for i in range(first, len(frames)):
            k = posed.get(i)
            if k is not None:
                T = landmarks.keyframes[k].T_camera_world
                views[i] = self._view_of_keyframe(k)
                continue
            located = localised(self.map, frames[i].ids, frames[i].pixels, T, self._seed)
            if located is not None:
                T, kept = located
                views[i] = self._view(frames[i].number, T, frames[i].ids[kept], frames[i].pixels[kept])
        self._backwards(frames, first, views)
        self.counts.lost += len(frames) - len(views)
        self.counts.numbers_lost += [frames[i].number for i in range(len(frames)) if i not in views]
        last = landmarks.keyframes[-1]
        self._state = _State(
            last.number,
            last.grey,
            frames[-1].valid,
            last.T_camera_world,
            last.ids,
            last.pixels,
            len(self._thumbnails) - 1,
        )
        self._replenish()
        before = views.get(len(frames) - 2)
        if before is not None:
            self._motion = last.T_camera_world @ inverse_se3(self.pose(before))
        return [views[i] for i in sorted(views)]

    def _backwards(self, frames: list[SeenFrame], first: int, views: dict[int, View]) -> None:
        """Poses for the frames before the map's first, followed from there against time."""
        keyframe = self.map.keyframes[0]
        after = _State(
            keyframe.number, frames[first].grey, None, keyframe.T_camera_world, keyframe.ids, keyframe.pixels
        )
        for i in range(first - 1, -1, -1):
            frame = frames[i]
            pixels, found = flow(after.grey, frame.grey, after.pixels, after.pixels)
            ids, pixels = after.ids[found], pixels[found]
            located = localised(self.map, ids, pixels, after.T, self._seed)
            if located is None:
                return
            T, kept = located
            ids, pixels = ids[kept], pixels[kept]
            more_ids, more_pixels = searched(self.map, T, frame.grey, ids, pixels)
            ids, pixels = np.concatenate([ids, more_ids]), np.concatenate([pixels, more_pixels])
            located = localised(self.map, ids, pixels, T, self._seed)
            if located is None:
                return
            T, kept = located
            after = _State(frame.number, frame.grey, None, T, ids[kept], pixels[kept])
            views[i] = self._view(frame.number, T, after.ids, after.pixels)
            views[i].keyframe, views[i].T_camera_keyframe = 0, T @ inverse_se3(keyframe.T_camera_world)

    # ------------------------------------------------------------------------------------------------- following

    def _follow(self, number: int, grey: NDArray[np.uint8], valid: NDArray[np.bool_] | None) -> View | None:
        state = self._state
        predicted = orthonormalised(self._motion @ state.T)
        pixels, found = flow(state.grey, grey, state.pixels, self._predicted(predicted))
        located = localised(self.map, state.ids[found], pixels[found], predicted, self._seed)
        if located is None:  # the motion may have been another
            pixels, found = flow(state.grey, grey, state.pixels, state.pixels)
            located = localised(self.map, state.ids[found], pixels[found], state.T, self._seed)
        if located is None:
            return self._bridge(number, grey, valid)
        T, kept = located
        ids, pixels = state.ids[found][kept], pixels[found][kept]
        self._motion = T @ inverse_se3(state.T)
        self._state = _State(number, grey, valid, T, ids, pixels)
        if self._wants_keyframe():
            self._make_keyframe()
            return self._view_of_keyframe(len(self.map.keyframes) - 1)
        known = self.map.known[ids]
        return self._view(number, T, ids[known], pixels[known])

    def _predicted(self, T: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where the followed features will be seen from T; those without a place are as far as most others."""
        state = self._state
        known = self.map.known[state.ids]
        world = self.map.xyz[state.ids].copy()
        depth = world[known] @ state.T[2, :3] + state.T[2, 3]
        typical = float(np.median(depth)) if len(depth) else 1.0
        rays = self.map.lens.rays(state.pixels[~known])
        world[~known] = (np.c_[rays, np.ones(len(rays))] * typical - state.T[:3, 3]) @ state.T[:3, :3]
        guess = self.map.lens.pixels(world @ T[:3, :3].T + T[:3, 3])
        # What was seen off its projection is so still.
        here = self.map.lens.pixels(world @ state.T[:3, :3].T + state.T[:3, 3])
        guess = guess + (state.pixels - here)
        return np.where(np.isfinite(guess).all(axis=1)[:, None], guess, state.pixels)

    # ------------------------------------------------------------------------------------------------- keyframes

    def _wants_keyframe(self) -> bool:
        last, state = self.map.keyframes[-1], self._state
        share, a, b = np.intersect1d(last.ids, state.ids, return_indices=True)
        if len(share) < FEWEST:
            return True
        if self.map.known[share].sum() < KEYFRAME_SHARE * self.map.known[last.ids].sum():
            return True
        shift = float(np.median(np.linalg.norm(last.pixels[a] - state.pixels[b], axis=1)))
        return shift > (0.6 if self._refines else 1.0) * KEYFRAME_SHIFT * max(state.grey.shape)

    def _make_keyframe(self) -> None:
        """The last frame becomes a keyframe: its landmarks placed exactly, more of them found, the map adjusted."""
        state = self._state
        ids = state.ids
        pixels = realigned(self.map, state.T, state.grey, ids, state.pixels)
        more_ids, more_pixels = searched(self.map, state.T, state.grey, ids, pixels)
        ids, pixels = np.concatenate([ids, more_ids]), np.concatenate([pixels, more_pixels])
        located = localised(self.map, ids, pixels, state.T, self._seed)
        if located is not None:
            state.T, kept = located
            ids, pixels = ids[kept], pixels[kept]
        state.ids, state.pixels = ids, pixels
        self._insert_keyframe()

    def _insert_keyframe(self) -> None:
        state, landmarks = self._state, self.map
        self._replenish(insert=True)
        k = len(landmarks.keyframes) - 1
        state.keyframe = k
        landmarks.triangulate(k)
        self._adjust()
        keyframe = landmarks.keyframes[k]
        state.T = keyframe.T_camera_world
        still = np.isin(state.ids, keyframe.ids)
        state.ids, state.pixels = state.ids[still], state.pixels[still]

    def _replenish(self, insert: bool = False) -> None:
        """New corners for the followed image, which becomes a keyframe where `insert` is set, or is the last one."""
        state, landmarks = self._state, self.map
        if insert:
            rays = landmarks.lens.rays(state.pixels)
            landmarks.add_keyframe(
                Keyframe(state.number, state.T, state.grey, state.ids.copy(), state.pixels.copy(), rays)
            )
            self._thumbnails.append(thumbnail(state.grey))
        new = corners(state.grey, state.pixels, WANTED, state.valid)
        ids = landmarks.new_ids(len(new))
        k = len(landmarks.keyframes) - 1
        landmarks.keyframes[k].append(ids, new, landmarks.lens.rays(new))
        landmarks.note_observations(k, ids, new)
        state.ids, state.pixels = np.concatenate([state.ids, ids]), np.concatenate([state.pixels, new])

    def _adjust(self) -> None:
        landmarks = self.map
        count = len(landmarks.keyframes)
        if self._refines and count in REFINED_AT:
            self.refine_camera()
            return
        free = list(range(max(0, count - (WIDE_WINDOW if count % WIDE_EVERY == 0 else WINDOW)), count))
        held = self._companions(free)
        if not held:
            held, free = free[:2], free[2:]
        adjust_bundle(landmarks, free, held, steps=8)
        landmarks.discard_outliers(free)

    def refine_camera(self) -> None:
        """Bundle adjustment of the whole map and of the camera's focal length and distortion, as far as they show."""
        count = len(self.map.keyframes)
        every = range(count)
        for _ in range(2):
            adjust_bundle(self.map, every, steps=15, focal=True, distortion=count >= DISTORTION_FROM)
            self.map.discard_outliers(every)

    def _companions(self, free: list[int]) -> list[int]:
        """Keyframes that see most of what `free` sees."""
        seen = np.zeros(len(self.map.known), dtype=bool)
        seen[self.map.observations(free)[2]] = True
        others = [k for k in range(len(self.map.keyframes)) if k not in set(free)]
        shared = [int(seen[self.map.keyframes[k].ids].sum()) for k in others]
        order = sorted(range(len(others)), key=lambda i: (-shared[i], -others[i]))
        return sorted(others[i] for i in order[:HELD] if shared[i] >= 15)

    def _view_of_keyframe(self, k: int) -> View:
        keyframe = self.map.keyframes[k]
        known = self.map.known[keyframe.ids]
        return View(keyframe.number, k, np.eye(4), keyframe.ids[known], keyframe.pixels[known])

    def _view(self, number: int, T: NDArray[np.float64], ids: NDArray[np.int64], pixels: NDArray[np.float64]) -> View:
        """A view seen from its nearest keyframe in time, among those before it."""
        k = max(
            (k for k, keyframe in enumerate(self.map.keyframes) if keyframe.number <= number),
            default=0,
            key=lambda k: self.map.keyframes[k].number,
        )
        known = self.map.known[ids]
        T_k = self.map.keyframes[k].T_camera_world
        return View(number, k, T @ inverse_se3(T_k), ids[known], pixels[known])

    # ------------------------------------------------------------------------------------------------- gaps

    def _bridge(self, number: int, grey: NDArray[np.uint8], valid: NDArray[np.bool_] | None) -> View | None:
        """A frame that flow does not reach from the one before: by its features, the frame before made a keyframe."""
        if self._state.keyframe is None:
            self._make_keyframe()
        features = describe(grey)
        count = len(self.map.keyframes)
        view = self._placed(number, grey, valid, features, range(count - 1, max(-1, count - 4), -1))
        if view is None:
            self._state = None
            self._lost_for = 0
        else:
            self.counts.bridged += 1
        return view

    def _recover(self, number: int, grey: NDArray[np.uint8], valid: NDArray[np.bool_] | None) -> View | None:
        """A frame after the track was lost, by the keyframes that look most like it."""
        self._lost_for += 1
        if self._lost_for > EAGER and self._lost_for % LAZY:
            return None
        features = describe(grey)
        if len(features.pixels) < FEWEST:
            return None
        candidates = alike_keyframes(np.array(self._thumbnails), grey, 3)
        candidates = [
            *candidates,
            *([len(self.map.keyframes) - 1] if len(self.map.keyframes) - 1 not in candidates else []),
        ]
        view = self._placed(number, grey, valid, features, candidates)
        if view is not None:
            self.counts.recovered += 1
        return view

    def _placed(
        self,
        number: int,
        grey: NDArray[np.uint8],
        valid: NDArray[np.bool_] | None,
        features: Features,
        candidates: Sequence[int],
    ) -> View | None:
        """The frame by the first of these keyframes that fits; it becomes a keyframe itself."""
        for k in candidates:
            placed = place_by_features(self.map, k, features, self._seed)
            if placed is None:
                continue
            T = placed.T_camera_world
            nothing = np.zeros(0, dtype=np.int64), np.zeros((0, 2))
            ids, pixels = searched(self.map, T, grey, *nothing)
            more_ids, more_pixels = inherited(self.map, k, features, placed.pairs, T)
            fresh = ~np.isin(more_ids, ids)
            ids, pixels = np.concatenate([ids, more_ids[fresh]]), np.concatenate([pixels, more_pixels[fresh]])
            located = localised(self.map, ids, pixels, T, self._seed)
            if located is None:
                continue
            T, kept = located
            self._state = _State(number, grey, valid, T, ids[kept], pixels[kept])
            self._motion = np.eye(4)
            self._insert_keyframe()
            return self._view_of_keyframe(len(self.map.keyframes) - 1)
        return None
