"""Visual odometry: poses of frames as they arrive and maps of landmarks, independent of files and settings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.klt.camera import CameraRefinement, Lens
from modp_ti.inputs.klt.initialisation import Initialisation
from modp_ti.inputs.klt.loop_closing import LoopClosing
from modp_ti.inputs.klt.map_joining import MapJoining, connected, joint_similarity
from modp_ti.inputs.klt.tracking import Tracking, View
from modp_ti.inputs.multiview.frame import Frame

# Keyframes or frames from which the frames of the first map are delivered. A map that is lost before is that of a bad
# start.
ESTABLISHED = 8
ESTABLISHED_FRAMES = 60
# Views that may wait with their landmarks for their map to be joined; older ones wait with their poses only.
WAITING_WITH_POINTS = 2000


class Odometry:
    """Estimates poses of frames in order, and builds maps of keyframes and landmarks.

    When a map is lost, another one is begun. Maps that show the same place are joined. The frames of one map, the
    run's, are returned as they come; those of any other wait until it is joined with that.

    Args:
        lens: The camera.
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
        tracking: The run's map and the tracking of frames with it; None as long as there is none. It stays the same
            object.
        joined: Number of maps that were joined with another one.
        places: Number of maps that could become the run's by their place, once `finish` was called.
    """

    def __init__(
        self,
        lens: Lens,
        seed: int = 0,
        refinement: CameraRefinement | None = None,
        begins_anew_after: int | None = None,
        loops: bool = False,
        waits: bool = True,
        place: int | None = None,
    ) -> None:
        self.joined = self.places = 0
        self.tracking: Tracking | None = None
        self._initialisation: Initialisation | None = Initialisation(lens, seed)
        self._refinement = refinement
        self._begins_anew_after = begins_anew_after
        self._waits = waits and begins_anew_after is not None
        self._place = place
        self._seed = seed
        self._joining = MapJoining(seed)
        self._loops = LoopClosing(seed, waits) if loops else None
        self._maps: list[Tracking] = []
        self._active: Tracking | None = None

    @property
    def recovered(self) -> int:
        """Number of frames that were relocalised after the track was lost."""
        return sum(each.recovered for each in self._maps)

    @property
    def loops(self) -> int:
        """Number of loops that were closed."""
        return 0 if self._loops is None else self._loops.closed

    @property
    def unsolved(self) -> int:
        """Number of bundle adjustments for which Ceres found no usable solution."""
        return sum(each.map.unsolved for each in self._maps)

    @property
    def undone(self) -> int:
        """Number of loops and joins that adjustment contradicted."""
        return self._joining.refused + (0 if self._loops is None else self._loops.undone)

    @property
    def lacking(self) -> str:
        """Why no map has begun."""
        return "" if self._initialisation is None else self._initialisation.lacking

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
        frame, active = Frame(number, grey, valid), self._active
        if active is not None:
            view = active.track(frame) or self._found_elsewhere(active, frame)
            if view is not None:
                self._initialisation = None
                return self._placed([view])
            if self._begins_anew_after is None:
                return []
            if self._initialisation is None:
                self._initialisation = Initialisation((self.tracking or active).map.lens, self._seed)
        assert self._initialisation is not None
        frame.ids, frame.pixels = frame.ids[:0], frame.pixels[:0]  # those of the lost map
        may_begin = active is None or active.lost_for >= (self._begins_anew_after or 0)
        landmarks = self._initialisation.add(frame, may_begin)
        if landmarks is None:
            return []
        refinement = self._refinement if self.tracking is None else None
        self._active = Tracking(landmarks, valid, self._seed, refinement)
        self._maps.append(self._active)
        views = self._active.start(self._initialisation.frames)
        self._initialisation = None
        return self._placed(views)

    def finish(self) -> list[View]:
        """Choose the map of the wanted place, or the largest, if none has become the run's, and close its last loops.

        Returns:
            Its views.
        """
        ranked = sorted(self._maps, key=lambda each: -len(each.waiting))
        ranked = [each for each in ranked if _is_established(each)] or ranked[:1]
        self.places = len(ranked)
        if self.tracking is None:
            place = self._place or 1
            if place > len(ranked):
                return []
            self.tracking = ranked[place - 1]
        if self._loops is not None:
            self._loops.finish(self.tracking)
        return _released(self.tracking)

    def _found_elsewhere(self, lost: Tracking, frame: Frame) -> View | None:
        """Relocalise a frame in another map, which is then tracked."""
        for each in self._maps if lost.is_sought else ():
            view = None if each is lost else each.recover(frame)
            if view is not None:
                self._active = each
                return view
        return None

    def _placed(self, views: list[View]) -> list[View]:
        """Add views to the map that is tracked, join it with others, and return what can be delivered."""
        active = self._active
        assert active is not None
        active.waiting += views
        if views[-1].number == views[-1].keyframe:
            self._active = joined = self._join(active)
            if self._loops is not None and joined is active:
                self._loops.at_keyframe(active)
            active = joined
        if self.tracking is None and self._place is None and (not self._waits or _is_established(active)):
            self.tracking = active
        if active is self.tracking:
            return _released(active)
        waiting = active.waiting
        if self._place is None and len(waiting) > WAITING_WITH_POINTS:
            waiting[-WAITING_WITH_POINTS - 1].forget_landmarks()
        return []

    def _join(self, active: Tracking) -> Tracking:
        """Join the map that is tracked with another one, if its last keyframe completes the evidence.

        Nothing changes if the joint map contradicts that. Returns the tracking that goes on.
        """
        found = self._joining.found(active, [each for each in self._maps if each is not active])
        if found is None:
            return active
        other, recognitions = found
        S = joint_similarity(other.map, active.map, recognitions, self._seed)
        # The run's map, or the older one, keeps its world and its ids.
        stays, goes = other, active
        run = self.tracking
        if active is run or (other is not run and self._maps.index(active) < self._maps.index(other)):
            stays, goes, S = active, other, np.asarray(np.linalg.inv(S), np.float64)
        joint = stays.map.copy()
        offset = joint.absorb(goes.map.copy(), S)
        if not connected(joint, recognitions):
            self._joining.refuse(active)
            return active
        stays.join(goes, joint, offset, S, follows=goes is active)
        if self._loops is not None:
            self._loops.begin_anew()
        self._maps.remove(goes)
        self.joined += 1
        return stays


def _is_established(tracking: Tracking) -> bool:
    return len(tracking.map.keyframes) >= ESTABLISHED or len(tracking.waiting) >= ESTABLISHED_FRAMES


def _released(tracking: Tracking) -> list[View]:
    views, tracking.waiting = sorted(tracking.waiting, key=lambda view: view.number), []
    return views
