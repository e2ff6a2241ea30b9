"""Visual odometry: poses of frames as they arrive and maps of landmarks, independent of files and settings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from modp_ti.inputs.klt.camera import CameraRefinement, Lens
from modp_ti.inputs.klt.frame import Frame
from modp_ti.inputs.klt.initialisation import Initialisation
from modp_ti.inputs.klt.landmark_map import LandmarkMap
from modp_ti.inputs.klt.loop_closing import LoopClosing
from modp_ti.inputs.klt.map_connection import MapJoining, connected, joint_similarity
from modp_ti.inputs.klt.tracking import Tracking, View

# Keyframes or frames from which the frames of the first map are delivered. A map that is lost before is that of a bad
# start.
ESTABLISHED = 8
ESTABLISHED_FRAMES = 60
# Views that may wait with their landmarks for their map to be joined; older ones wait with their poses only.
WAITING_WITH_POINTS = 2000


@dataclass(eq=False)
class _Submap:
    """A map with the views of its frames that have not been delivered."""

    tracking: Tracking
    waiting: list[View] = field(default_factory=list)


class Odometry:
    """Estimates poses of frames in order, and builds maps of keyframes and landmarks.

    When a map is lost, another one is begun. Maps that show the same place are joined. The frames of one map, the
    run's, are returned as they come; those of any other wait until it is joined with that.

    Args:
        lenses: The camera, or several candidates. The initialisation chooses the one that fits best.
        seed: Seed of RANSAC.
        refinement: When the camera is refined together with the map, for images whose camera is unknown; None for a
            known one.
        begins_anew_after: Number of frames without a pose after which another map may begin; None for never.
        loops: Whether loops are closed.
        waits: Whether the frames of the first map wait until it has enough keyframes or frames to be the run's, and
            whether tracking waits for a loop that is closed at a certain keyframe. Otherwise results depend on time.
        place: Place by size, from 1, of the map that becomes the run's when all frames are tracked; None for the first
            one that has enough keyframes or frames, while they are tracked.

    Attributes:
        joined: Number of maps that were joined with another one.
        places: Number of maps that could become the run's by their place, once `finish` was called.
    """

    def __init__(
        self,
        lenses: Sequence[Lens],
        seed: int = 0,
        refinement: CameraRefinement | None = None,
        begins_anew_after: int | None = None,
        loops: bool = False,
        waits: bool = True,
        place: int | None = None,
    ) -> None:
        self.joined = self.places = 0
        self._initialisation: Initialisation | None = Initialisation(lenses, seed)
        self._refinement = refinement
        self._begins_anew_after = begins_anew_after
        self._waits = waits and begins_anew_after is not None
        self._place = place
        self._seed = seed
        self._joining = MapJoining(seed)
        self._loops = LoopClosing(seed, waits) if loops else None
        self._maps: list[_Submap] = []
        self._active: _Submap | None = None
        self._run: _Submap | None = None

    @property
    def tracking(self) -> Tracking | None:
        """The run's map and the tracking of frames with it; None as long as there is none. It stays the same object."""
        return None if self._run is None else self._run.tracking

    @property
    def recovered(self) -> int:
        """Number of frames that were relocalised after the track was lost."""
        return sum(each.tracking.recovered for each in self._maps)

    @property
    def loops(self) -> int:
        """Number of loops that were closed."""
        return 0 if self._loops is None else self._loops.closed

    @property
    def unsolved(self) -> int:
        """Number of bundle adjustments for which Ceres found no usable solution."""
        return sum(each.tracking.map.unsolved for each in self._maps)

    @property
    def undone(self) -> int:
        """Number of loops and joins that adjustment contradicted."""
        return self._joining.refused + (0 if self._loops is None else self._loops.undone)

    @property
    def waiting(self) -> list[list[int]]:
        """Numbers of the frames of each map that has not been joined with the run's."""
        return [[view.number for view in each.waiting] for each in self._maps if each.waiting]

    def process(self, number: int, grey: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None) -> list[View]:
        """Track one frame.

        Args:
            number: Number of the frame, increasing.
            grey: (H, W) uint8.
            valid: (H, W), False where no features may be tracked.

        Returns:
            The views that this frame adds to the run's map, in order: none, this frame, or, when a map becomes the
            run's or is joined with it, all its frames so far that could be localised.
        """
        frame = Frame(number, grey, valid)
        if self._active is not None:
            view = self._active.tracking.track(frame) or self._found_elsewhere(self._active.tracking, frame)
            if view is not None:
                self._initialisation = None
                return self._placed(self._active, [view])
            if self._begins_anew_after is None:
                return []
            if self._initialisation is None:
                lens = (self._run or self._active).tracking.map.lens
                self._initialisation = Initialisation([lens], self._seed)
        assert self._initialisation is not None
        frame.ids, frame.pixels = frame.ids[:0], frame.pixels[:0]  # those of the lost map
        landmarks = self._initialisation.add(frame, self._may_begin())
        if landmarks is None:
            return []
        submap, views = self._begin(landmarks, self._initialisation.frames)
        self._initialisation = None
        self._maps.append(submap)
        self._active = submap
        return self._placed(submap, views)

    def finish(self) -> list[View]:
        """Choose the map of the wanted place, or the largest, if none has become the run's, and close its last loops.

        Returns:
            Its views.
        """
        ranked = self._ranked()
        self.places = len(ranked)
        if self._run is None:
            place = self._place or 1
            if place > len(ranked):
                return []
            self._run = ranked[place - 1]
        if self._loops is not None:
            self._loops.finish(self._run.tracking)
        return self._released()

    def _ranked(self) -> list[_Submap]:
        """The maps with enough keyframes or frames, or any if there are none, the one with the most frames first."""
        ranked = sorted(self._maps, key=lambda each: -len(each.waiting))
        return [each for each in ranked if self._is_established(each)] or ranked[:1]

    def _may_begin(self) -> bool:
        return self._active is None or self._active.tracking.lost_for >= (self._begins_anew_after or 0)

    def _found_elsewhere(self, lost: Tracking, frame: Frame) -> View | None:
        """Relocalise a frame in another map, which is then tracked."""
        if not lost.is_sought:
            return None
        for each in self._maps:
            if each.tracking is lost:
                continue
            view = each.tracking.recover(frame)
            if view is not None:
                self._active = each
                return view
        return None

    def _placed(self, submap: _Submap, views: list[View]) -> list[View]:
        """Add views to the map that is tracked, join it with others, and return what can be delivered."""
        submap.waiting += views
        if views[-1].number == views[-1].keyframe.number:
            self._join(submap)
            if self._loops is not None and submap is self._active:
                self._loops.at_keyframe(submap.tracking)
        assert self._active is not None
        if self._run is None and self._place is None and (not self._waits or self._is_established(self._active)):
            self._run = self._active
        if submap is self._run or self._active is self._run:
            return self._released()
        old = 0 if self._place is not None else len(submap.waiting) - WAITING_WITH_POINTS
        if old > 0:
            view = submap.waiting[old - 1]
            submap.waiting[old - 1] = replace(view, ids=view.ids[:0].copy(), pixels=view.pixels[:0].copy())
        return []

    @staticmethod
    def _is_established(submap: _Submap) -> bool:
        return len(submap.tracking.map.keyframes) >= ESTABLISHED or len(submap.waiting) >= ESTABLISHED_FRAMES

    def _released(self) -> list[View]:
        assert self._run is not None
        views, self._run.waiting = sorted(self._run.waiting, key=lambda view: view.number), []
        return views

    def _join(self, active: _Submap) -> None:
        """Join the map that is tracked with another one, if its last keyframe completes the evidence.

        Nothing changes if the joint map contradicts that.
        """
        others = [each for each in self._maps if each is not active]
        found = self._joining.found(active.tracking, [each.tracking for each in others])
        if found is None:
            return
        tracking, recognitions = found
        other = next(each for each in others if each.tracking is tracking)
        S = joint_similarity(other.tracking.map, active.tracking.map, recognitions, self._seed)
        # The run's map, or the older one, keeps its world and its ids.
        stays, goes = other, active
        if active is self._run or (other is not self._run and self._maps.index(active) < self._maps.index(other)):
            stays, goes, S = active, other, np.asarray(np.linalg.inv(S), np.float64)
        joint = stays.tracking.map.copy()
        joint.absorb(goes.tracking.map.copy(), S)
        if not connected(joint, recognitions):
            self._joining.refuse(active.tracking)
            return
        offset = stays.tracking.absorb(goes.tracking, S, follows=goes is active)
        stays.tracking.map.adopt(joint)
        stays.waiting += [replace(view, ids=view.ids + offset) for view in goes.waiting]
        if self._loops is not None:
            self._loops.begin_anew()
        self._maps.remove(goes)
        self._active = stays
        self.joined += 1

    def _begin(self, landmarks: LandmarkMap, frames: list[Frame]) -> tuple[_Submap, list[View]]:
        """Start from an initial map: localise the frames between its keyframes and those before the first one."""
        refinement = self._refinement if self._run is None else None
        tracking = Tracking(landmarks, frames[-1].valid, self._seed, refinement)
        posed = {keyframe.number: k for k, keyframe in enumerate(landmarks.keyframes)}
        first = next(i for i, frame in enumerate(frames) if frame.number in posed)
        views = list(_earlier_views(tracking, frames[:first]))[::-1]
        T = landmarks.keyframes[0].T_camera_world
        for frame in frames[first:]:
            k = posed.get(frame.number)
            if k is not None:
                T = landmarks.keyframes[k].T_camera_world
                views.append(tracking.view_of_keyframe(k))
                continue
            located = tracking.localised(frame, T)
            if located is not None:
                T = located.T_camera_world
                views.append(tracking.view(located))
        before = views[-2]  # the last view is that of the last keyframe
        if before.number == frames[-2].number:
            tracking.motion = landmarks.keyframes[-1].T_camera_world @ inverse_se3(tracking.pose(before))
        return _Submap(tracking), views


def _earlier_views(tracking: Tracking, frames: list[Frame]) -> Iterator[View]:
    """Localise the frames before the first keyframe by tracking from it backwards in time."""
    keyframe = tracking.map.keyframes[0]
    after = Frame(keyframe.number, keyframe.grey, None, keyframe.ids, keyframe.pixels)
    T = keyframe.T_camera_world
    for frame in reversed(frames):
        frame.track(after)
        located = tracking.localised(frame, T)
        if located is None:
            return
        tracking.search(located)
        located = tracking.localised(located, located.T_camera_world)
        if located is None:
            return
        after, T = located, located.T_camera_world
        yield tracking.view(located)
