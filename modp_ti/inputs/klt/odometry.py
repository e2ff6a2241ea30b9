"""Visual odometry: poses of frames as they arrive and a map of landmarks, independent of files and settings."""

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
from modp_ti.inputs.multiview.bundle_adjustment import Refinable
from modp_ti.inputs.multiview.features import Features

__all__ = ["Odometry", "View"]

WANTED = 450  # features that are tracked
# A frame becomes a keyframe if the features have moved by KEYFRAME_SHIFT of the image's longer side since the last
# keyframe, or if less than KEYFRAME_SHARE of its landmarks are still seen.
KEYFRAME_SHIFT = 0.05
KEYFRAME_SHARE = 0.65
WINDOW = 8  # free keyframes of a local bundle adjustment
HELD = 12  # fixed keyframes of a local bundle adjustment, at most
WIDE_EVERY = 12  # keyframes between bundle adjustments of WIDE_WINDOW free ones
WIDE_WINDOW = 30
# Numbers of keyframes from which focal length and distortion are estimated. Fewer keyframes fit almost any camera.
FOCAL_FROM = 6
DISTORTION_FROM = 12
REFINED_AT = (6, 12, 24, 48)
# Relocalisation is tried at each of the first EAGER frames after the track was lost, then at every LAZY-th frame.
EAGER = 10
LAZY = 5


@dataclass
class View:
    """A frame with a pose relative to its keyframe.

    Attributes:
        number: Number of the frame.
        keyframe: Index of its keyframe in the map.
        T_camera_keyframe: (4, 4) pose relative to the keyframe.
        ids: (N,) landmarks that it sees.
        pixels: (N, 2) their positions in the tracked image.
    """

    number: int
    keyframe: int
    T_camera_keyframe: NDArray[np.float64]
    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]


@dataclass
class _State:
    """The last tracked frame: image, pose and features."""

    number: int
    grey: NDArray[np.uint8]
    valid: NDArray[np.bool_] | None
    T: NDArray[np.float64]
    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]
    keyframe: int | None = None


@dataclass
class Counts:
    """Statistics of the frames: lost, relocalised after a loss, and bridged by feature matching without a loss."""

    lost: int = 0
    recovered: int = 0
    bridged: int = 0
    numbers_lost: list[int] = field(default_factory=list)


class Odometry:
    """Estimates poses of frames in order, and builds a map of keyframes and landmarks.

    Args:
        lenses: The camera, or several candidates. The initialisation chooses the one that fits best.
        seed: Seed of RANSAC.
        refines: Refine the camera together with the map, for images whose camera is unknown.

    Attributes:
        map: The map; None before the initialisation has succeeded.
        counts: Statistics of the frames.
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
        """Number of frames that wait for the initialisation of the map."""
        return len(self._initialisation.frames) if self._initialisation is not None else 0

    def pose(self, view: View) -> NDArray[np.float64]:
        """T_camera_world (4, 4) of a view in the current map."""
        return orthonormalised(view.T_camera_keyframe @ self.map.keyframes[view.keyframe].T_camera_world)

    def process(self, number: int, grey: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None) -> list[View]:
        """Track one frame.

        Args:
            number: Number of the frame, increasing.
            grey: (H, W) uint8.
            valid: (H, W), False where no features may be tracked.

        Returns:
            The views that this frame adds, in order: none, this frame, or, when the map is initialised, all frames so
            far that could be localised.
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
        """Start from the initial map: localise the frames between its keyframes and those before the first one."""
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
        """Localise the frames before the first keyframe by tracking from it backwards in time."""
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
        if located is None:  # retry without the constant-velocity prediction
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
        """Predict the pixels of the tracked features at pose T. Untriangulated ones are given the median depth."""
        state = self._state
        known = self.map.known[state.ids]
        world = self.map.xyz[state.ids].copy()
        depth = world[known] @ state.T[2, :3] + state.T[2, 3]
        typical = float(np.median(depth)) if len(depth) else 1.0
        rays = self.map.lens.rays(state.pixels[~known])
        world[~known] = (np.c_[rays, np.ones(len(rays))] * typical - state.T[:3, 3]) @ state.T[:3, :3]
        guess = self.map.lens.pixels(world @ T[:3, :3].T + T[:3, 3])
        # The reprojection error of each feature is assumed to persist.
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
        """Make the last frame a keyframe: realign its landmarks, search for more, and adjust the map."""
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
        """Bundle adjust the whole map and the focal length, and with enough keyframes the distortion."""
        count = len(self.map.keyframes)
        every = range(count)
        refined: list[Refinable] = ["focal", "distortion"] if count >= DISTORTION_FROM else ["focal"]
        for _ in range(2):
            adjust_bundle(self.map, every, steps=15, refined=refined)
            self.map.discard_outliers(every)

    def _companions(self, free: list[int]) -> list[int]:
        """Other keyframes that share the most landmarks with `free`, at most HELD of them."""
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
        """A view relative to the last keyframe before it."""
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
        """Localise a frame where optical flow fails by SIFT matches with the last keyframes and the frame before."""
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
        """Relocalise a frame after the track was lost, against the most similar keyframes and the last one."""
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
        """Localise the frame against the first candidate keyframe that fits, and make it a keyframe."""
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
