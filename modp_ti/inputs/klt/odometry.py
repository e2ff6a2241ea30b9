"""Visual odometry: poses of frames as they arrive and a map of landmarks, independent of files and settings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from modp_ti.inputs.klt.camera_refinement import CameraRefinement
from modp_ti.inputs.klt.frame import Frame
from modp_ti.inputs.klt.initialisation import Initialisation
from modp_ti.inputs.klt.landmark_map import LandmarkMap
from modp_ti.inputs.klt.lens import Lens
from modp_ti.inputs.klt.tracking import Tracking, View

__all__ = ["Odometry"]


class Odometry:
    """Estimates poses of frames in order, and builds a map of keyframes and landmarks.

    Args:
        lenses: The camera, or several candidates. The initialisation chooses the one that fits best.
        seed: Seed of RANSAC.
        refinement: When the camera is refined together with the map, for images whose camera is unknown; None for a
            known one.

    Attributes:
        tracking: The map and the tracking of frames with it; None before the initialisation has succeeded.
    """

    def __init__(self, lenses: Sequence[Lens], seed: int = 0, refinement: CameraRefinement | None = None) -> None:
        self.tracking: Tracking | None = None
        self._initialisation = Initialisation(lenses, seed)
        self._refinement = refinement
        self._seed = seed

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
        frame = Frame(number, grey, valid)
        if self.tracking is not None:
            view = self.tracking.track(frame)
            return [] if view is None else [view]
        landmarks = self._initialisation.add(frame)
        return [] if landmarks is None else self._begin(landmarks)

    def _begin(self, landmarks: LandmarkMap) -> list[View]:
        """Start from the initial map: localise the frames between its keyframes and those before the first one."""
        frames, self._initialisation.frames = self._initialisation.frames, []
        tracking = self.tracking = Tracking(landmarks, frames[-1].valid, self._seed, self._refinement)
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
        return views


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
