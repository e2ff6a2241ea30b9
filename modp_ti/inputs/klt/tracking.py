"""Tracking of frames with a map, and the keyframes by which the map grows."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3, orthonormalised, scale_of
from modp_ti.inputs.klt.camera import CameraRefinement
from modp_ti.inputs.klt.landmark_map import LandmarkMap
from modp_ti.inputs.klt.localisation import FEWEST, SIGMA, localised, predicted_pixels, realigned, searched
from modp_ti.inputs.klt.recognition import inherited, place_by_features, thumbnail, world_points
from modp_ti.inputs.multiview.bundle_adjustment import Refinable
from modp_ti.inputs.multiview.features import match_anywhere
from modp_ti.inputs.multiview.frame import Frame, LocalisedFrame
from modp_ti.inputs.multiview.reprojection import refine_pose

# A frame becomes a keyframe if the features have moved by KEYFRAME_SHIFT of the image's longer side since the last
# keyframe, or if less than KEYFRAME_SHARE of its landmarks are still seen.
KEYFRAME_SHIFT = 0.05
KEYFRAME_SHARE = 0.65
SHARE_ASSUMED = 0.4  # of KEYFRAME_SHIFT, while landmarks have assumed depths
WINDOW = 8  # free keyframes of a local bundle adjustment
HELD = 12  # fixed keyframes of a local bundle adjustment, at most
LEAST_SHARED = 15  # landmarks that they share with the free ones
WIDE_EVERY = 12  # keyframes between bundle adjustments of WIDE_WINDOW free ones
WIDE_WINDOW = 30
# Relocalisation is tried at each of the first EAGER frames after the track was lost, then at every LAZY-th frame.
EAGER = 10
LAZY = 5
ALIKE = 3  # keyframes that look most like a frame, with which it is compared then


@dataclass
class View:
    """A frame with a pose relative to its keyframe.

    Attributes:
        number: Number of the frame.
        keyframe: Number of its keyframe.
        T_camera_keyframe: (4, 4) pose relative to the keyframe.
        ids: (N,) landmarks that it sees.
        pixels: (N, 2) their positions in the tracked image.
        scale: The keyframe's `scale` to which `T_camera_keyframe` belongs.
    """

    number: int
    keyframe: int
    T_camera_keyframe: NDArray[np.float64]
    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]
    scale: float

    def forget_landmarks(self) -> None:
        """Keep the pose only."""
        self.ids, self.pixels = self.ids[:0].copy(), self.pixels[:0].copy()


class Tracking:
    """Localises frames in order, from the last keyframe of a map on, and adds keyframes to the map.

    Args:
        landmarks: The initial map.
        valid: (H, W), False where no features of the last keyframe may be tracked.
        seed: Seed of RANSAC.
        refinement: When the camera is refined together with the map; None for a known camera.

    Attributes:
        map: The map.
        waiting: Views that have not been delivered.
        motion: (4, 4) T_camera_camera from the frame before to the last one, which predicts the next pose.
        recovered: Number of frames that were relocalised after the track was lost.
    """

    def __init__(
        self,
        landmarks: LandmarkMap,
        valid: NDArray[np.bool_] | None = None,
        seed: int = 0,
        refinement: CameraRefinement | None = None,
    ) -> None:
        self.map = landmarks
        self.waiting: list[View] = []
        self.motion = np.eye(4)
        self.recovered = 0
        self._seed = seed
        self._refinement = refinement
        self._thumbnails: list[NDArray[np.float32]] = []  # of the first keyframes, made when they are needed
        self._lost_for = 0
        self._counted = len(landmarks.keyframes)  # when the map was last adjusted
        self._wide_is_due = False
        last = landmarks.keyframes[-1].frame(valid)
        self._replenish(last)
        self._last: LocalisedFrame | None = last  # if it is a keyframe, the two share the array of their pose

    def pose(self, view: View) -> NDArray[np.float64]:
        """T_camera_world (4, 4) of a view in the current map."""
        keyframe, T = self.map.keyframes[self.map.index(view.keyframe)], view.T_camera_keyframe
        if view.scale != keyframe.scale:
            T = T.copy()
            T[:3, 3] *= keyframe.scale / view.scale
        return orthonormalised(T @ keyframe.T_camera_world)

    def start(self, frames: Sequence[Frame]) -> list[View]:
        """Localise the frames of the initialisation, those before the first keyframe by tracking backwards in time.

        Args:
            frames: Consecutive frames with their features, of which the last is the last keyframe.

        Returns:
            The views of those that could be localised, in order.
        """
        keyframes = self.map.keyframes
        place = {keyframe.number: k for k, keyframe in enumerate(keyframes)}
        first = next(i for i, frame in enumerate(frames) if frame.number in place)
        views = list(self._earlier_views(frames[:first]))[::-1]
        T = keyframes[0].T_camera_world
        for frame in frames[first:]:
            if frame.number in place:
                T = keyframes[place[frame.number]].T_camera_world
                views.append(self._view_of_keyframe(place[frame.number]))
                continue
            located = self._localised(frame, T)
            if located is not None:
                T = located.T_camera_world
                views.append(self._view(located))
        if views[-2].number == frames[-2].number:
            self.motion = keyframes[-1].T_camera_world @ inverse_se3(self.pose(views[-2]))
        return views

    def _earlier_views(self, frames: Sequence[Frame]) -> Iterator[View]:
        after = self.map.keyframes[0].frame()
        for frame in reversed(frames):
            frame.track(after)
            located = self._localised(frame, after.T_camera_world)
            if located is None:
                return
            located.append(*searched(self.map, located))
            located = self._localised(located, located.T_camera_world)
            if located is None:
                return
            after = located
            yield self._view(located)

    def track(self, frame: Frame) -> View | None:
        """Localise the next frame, which may become a keyframe. None if that fails."""
        if self._last is not None:
            return self._follow(self._last, frame)
        self._lost_for += 1
        return self.recover(frame) if self.is_sought else None

    @property
    def lost_for(self) -> int:
        """Number of frames since the track was lost; 0 while it is not."""
        return 0 if self._last is not None else self._lost_for + 1

    @property
    def is_sought(self) -> bool:
        """Whether a frame that cannot be tracked is compared with the keyframes, which is not done every time."""
        return self._lost_for <= EAGER or self._lost_for % LAZY == 0

    def _localised(self, frame: Frame, T_guess: NDArray[np.float64]) -> LocalisedFrame | None:
        return localised(self.map, frame, T_guess, self._seed)

    def _view_of_keyframe(self, k: int) -> View:
        keyframe = self.map.keyframes[k]
        known = self.map.known[keyframe.ids]
        ids, pixels = keyframe.ids[known], keyframe.pixels[known]
        return View(keyframe.number, keyframe.number, np.eye(4), ids, pixels, keyframe.scale)

    def _view(self, frame: LocalisedFrame) -> View:
        """The view of a frame relative to the last keyframe before it, or to the first keyframe."""
        keyframe = self.map.keyframes[max(0, self.map.index(frame.number))]
        T = frame.T_camera_world @ inverse_se3(keyframe.T_camera_world)
        known = self.map.known[frame.ids]
        return View(frame.number, keyframe.number, T, frame.ids[known], frame.pixels[known], keyframe.scale)

    def _follow(self, last: LocalisedFrame, frame: Frame) -> View | None:
        predicted = orthonormalised(self.motion @ last.T_camera_world)
        frame.track(last, predicted_pixels(self.map, last, predicted))
        located = self._localised(frame, predicted)
        if located is None:  # retry without the constant-velocity prediction
            frame.track(last)
            located = self._localised(frame, last.T_camera_world)
        if located is None:
            return self._bridge(last, frame)
        self.motion = located.T_camera_world @ inverse_se3(last.T_camera_world)
        if self._wants_keyframe(located):
            return self._make_keyframe(located)
        self._last = located
        view = self._view(located)
        if self._wide_is_due:
            self._wide_is_due = False
            self._adjust_last(WIDE_WINDOW)
            located.T_camera_world = self.pose(view)
        return view

    # ------------------------------------------------------------------------------------------------- keyframes

    def _wants_keyframe(self, frame: LocalisedFrame) -> bool:
        last = self.map.keyframes[-1]
        share, a, b = np.intersect1d(last.ids, frame.ids, return_indices=True)
        if len(share) < FEWEST:
            return True
        if self.map.known[share].sum() < KEYFRAME_SHARE * self.map.known[last.ids].sum():
            return True
        shift = float(np.median(np.linalg.norm(last.pixels[a] - frame.pixels[b], axis=1)))
        share_of_shift = 1.0 if self._refinement is None else self._refinement.share_of_shift
        if self.map.assumed[last.ids].any():  # the sooner depths are triangulated, the better
            share_of_shift *= SHARE_ASSUMED
        return shift > share_of_shift * KEYFRAME_SHIFT * max(frame.grey.shape)

    def _make_keyframe(self, frame: LocalisedFrame) -> View:
        """Make the last frame a keyframe: realign its landmarks, search for more, and adjust the map."""
        frame.pixels = realigned(self.map, frame)
        frame.append(*searched(self.map, frame))
        return self._insert_keyframe(self._localised(frame, frame.T_camera_world) or frame)

    def _insert_keyframe(self, frame: LocalisedFrame) -> View:
        k = self.map.add_keyframe(frame, frame.T_camera_world)
        self._replenish(frame)
        self.map.triangulate(k)
        self.map.assume_depths(k)
        self._adjust()
        keyframe = self.map.keyframes[k]
        still = np.isin(frame.ids, keyframe.ids)
        frame.ids, frame.pixels, frame.T_camera_world = frame.ids[still], frame.pixels[still], keyframe.T_camera_world
        self._last = frame
        return self._view_of_keyframe(k)

    def _replenish(self, frame: Frame) -> None:
        """Detect new corners in the frame of the last keyframe, and add them to both."""
        new = frame.new_corners()
        ids = self.map.new_ids(len(new))
        self.map.observe(len(self.map.keyframes) - 1, ids, new)
        frame.append(ids, new)

    def _adjust(self) -> None:
        count = len(self.map.keyframes)
        before, self._counted = self._counted, count
        if self._refinement is not None and any(before < at <= count for at in self._refinement.at):
            self._refine_camera_in_use() if self._refinement.settles else self.refine_camera()
            return
        # The wide adjustment comes with the next frame that is no keyframe, because a keyframe costs enough without it;
        # if the next frame is a keyframe, then with that.
        self._adjust_last(WIDE_WINDOW if self._wide_is_due else WINDOW)
        self._wide_is_due = count % WIDE_EVERY == 0

    def _adjust_last(self, window: int) -> None:
        """Bundle adjust the last `window` keyframes."""
        count = len(self.map.keyframes)
        free = list(range(max(0, count - window), count))
        held = self._companions(free)
        if not held:
            held, free = free[:2], free[2:]
        self.map.adjust(free, held, steps=8)
        self.map.discard_outliers(free)

    def _companions(self, free: list[int]) -> list[int]:
        """Other keyframes that share the most landmarks with `free`, at most HELD of them."""
        seen = np.zeros(len(self.map.known), dtype=bool)
        seen[self.map.observations(free)[1]] = True
        others = [k for k in range(len(self.map.keyframes)) if k not in set(free)]
        shared = {k: int(seen[self.map.keyframes[k].ids].sum()) for k in others}
        closest = sorted(others, key=lambda k: (-shared[k], -k))[:HELD]
        return sorted(k for k in closest if shared[k] >= LEAST_SHARED)

    # ------------------------------------------------------------------------------------------------- camera

    @property
    def camera_is_final(self) -> bool:
        """Whether the camera is known, or has been refined for the last time."""
        return self._refinement is None

    def refine_camera(self) -> None:
        """Bundle adjust the whole map and the focal length, and with enough keyframes the distortion."""
        assert self._refinement is not None, "the camera is known"
        every = range(len(self.map.keyframes))
        with_distortion = len(every) >= self._refinement.distortion_from
        refined: list[Refinable] = ["focal", "distortion"] if with_distortion else ["focal"]
        for _ in range(2):
            self.map.adjust(every, steps=15, refined=refined)
            self.map.discard_outliers(every)

    def _refine_camera_in_use(self) -> None:
        """Refine the camera, and undo that if the result is implausible. The last refinement makes it final."""
        assert self._refinement is not None
        before = self.map.copy()
        self.refine_camera()
        if not self.map.lens.is_plausible:
            self.map = before
        if len(self.map.keyframes) >= self._refinement.at[-1]:
            self._refinement = None

    def relocalise(self, view: View) -> None:
        """Refine the pose of an earlier view, after the map and its camera have changed."""
        known = self.map.known[view.ids]
        if view.number == view.keyframe or known.sum() < FEWEST:
            return
        keyframe = self.map.keyframes[self.map.index(view.keyframe)]
        rays = self.map.lens.rays(view.pixels[known])
        T = refine_pose(self.pose(view), self.map.xyz[view.ids[known]], rays, SIGMA / self.map.lens.focal)
        view.T_camera_keyframe, view.scale = T @ inverse_se3(keyframe.T_camera_world), keyframe.scale

    # ------------------------------------------------------------------------------------------------- other maps

    def join(
        self, other: Tracking, joint: LandmarkMap, offset: int, S_self_other: NDArray[np.float64], follows: bool
    ) -> None:
        """Continue with a map that joins this one with that of another tracking. The last frame is a keyframe.

        Args:
            other: The other tracking, which must not be used afterwards.
            joint: The joint map.
            offset: What the ids of the other map have grown by in it.
            S_self_other: (4, 4) similarity from the other's world to this one.
            follows: Whether the last frame is the other's.
        """
        self.map = joint
        self._thumbnails = []
        self.recovered += other.recovered
        for view in other.waiting:
            view.ids = view.ids + offset
        self.waiting += other.waiting
        if follows:
            self._last, self.motion = other._last, other.motion.copy()
            self.motion[:3, 3] *= float(scale_of(S_self_other))
            assert self._last is not None
            self._last.ids = self._last.ids + offset
        assert self._last is not None
        self._last.T_camera_world = joint.keyframes[-1].T_camera_world

    def follow_moves(self, moves: Sequence[NDArray[np.float64]]) -> None:
        """Note that the keyframes were moved by S_after_before (4, 4), when the last frame is a keyframe or the end."""
        self.motion = self.motion.copy()
        self.motion[:3, 3] *= float(scale_of(moves[-1]))
        self._wide_is_due = True

    # ------------------------------------------------------------------------------------------------- gaps

    def _bridge(self, last: LocalisedFrame, frame: Frame) -> View | None:
        """Localise a frame where optical flow fails by SIFT matches with the last keyframes and the frame before."""
        if self.map.keyframes[-1].number != last.number:
            self._make_keyframe(last)
        count = len(self.map.keyframes)
        view = self._placed(frame, range(count - 1, max(-1, count - 4), -1))
        if view is None:
            self._last = None
            self._lost_for = 0
        return view

    def recover(self, frame: Frame) -> View | None:
        """Relocalise a frame after the track was lost, against the most similar keyframes and the last one."""
        if len(frame.described.pixels) < FEWEST:
            return None
        self._thumbnails += [thumbnail(each.grey) for each in self.map.keyframes[len(self._thumbnails) :]]
        likeness = np.array(self._thumbnails) @ thumbnail(frame.grey)
        alike = np.argsort(-likeness, kind="stable")[:ALIKE].tolist()
        view = self._placed(frame, dict.fromkeys([*alike, len(self.map.keyframes) - 1]))
        if view is not None:
            self.recovered += 1
        return view

    def _placed(self, frame: Frame, candidates: Iterable[int]) -> View | None:
        """Localise the frame against the first candidate keyframe that fits, and make it a keyframe.

        If none does, depths are assumed where they are not known.
        """
        matches: dict[int, NDArray[np.int64]] = {}
        for assumed, k in product((False, True), candidates):
            keyframe = self.map.keyframes[k]
            if k not in matches:
                matches[k] = match_anywhere(keyframe.described, frame.described)
            placed = place_by_features(self.map, keyframe, frame.described, matches[k], self._seed, assumed)
            if placed is None:
                continue
            T, pairs = placed
            located = LocalisedFrame(frame.number, frame.grey, frame.valid, T_camera_world=T)
            located.append(*searched(self.map, located))
            located.append(*inherited(self.map, k, frame.described, pairs, T))
            if assumed:
                own = keyframe.described_ids
                own, at = own[own >= 0], world_points(self.map, keyframe, assumed)[own >= 0]
                self.map.assume(own[np.isin(own, located.ids)], at[np.isin(own, located.ids)])
            located = self._localised(located, T)
            if located is not None:
                self.motion = np.eye(4)
                return self._insert_keyframe(located)
        return None
