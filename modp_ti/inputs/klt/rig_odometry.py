"""Visual odometry of a rig of cameras that share their centre, such as the faces of a panorama."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.klt.frame import Frame, LocalisedFrame
from modp_ti.inputs.klt.initialisation import BETWEEN, LEAST_ANGLE, LEAST_SHIFT, MAX_ERROR
from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap, triangulated
from modp_ti.inputs.klt.rig_tracking import RigTracking, localised_rig, replenished
from modp_ti.inputs.klt.tracking import View
from modp_ti.inputs.multiview.reprojection import ray_errors
from modp_ti.inputs.multiview.rig_pose import relative_rig_pose

__all__ = ["RigOdometry"]

FEWEST_SHARED = 80  # features that the two places of an initial map must share
LONGEST = 120  # times in memory before there is a map


class RigOdometry:
    """Estimates the poses of a rig, and builds a map of keyframes and landmarks.

    It does what `Odometry` does for one camera, without further maps and loops. Views are processed one by one, in the
    order of the rig's cameras; the views of a time that is not complete are left out.

    Args:
        lens: The camera of all views.
        mounts: (C, 4, 4) T_camera_rig of the views, which share their centre.
        seed: Seed of RANSAC.
    """

    joined = loops = undone = 0
    waiting: Sequence[list[int]] = ()

    def __init__(self, lens: Lens, mounts: NDArray[np.float64], seed: int = 0) -> None:
        self.tracking: RigTracking | None = None
        self._lens, self._mounts, self._seed = lens, mounts, seed
        self._views: list[Frame] = []  # of the time that is not complete
        self._times: list[list[Frame]] = []  # before there is a map
        self._count = 0  # features before there is a map

    @property
    def places(self) -> int:
        """Number of maps."""
        return int(self.tracking is not None)

    @property
    def recovered(self) -> int:
        """Number of places that were found again after the track was lost."""
        return 0 if self.tracking is None else self.tracking.recovered

    @property
    def unsolved(self) -> int:
        """Number of bundle adjustments for which Ceres found no usable solution."""
        return 0 if self.tracking is None else self.tracking.map.unsolved

    def process(self, number: int, grey: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None) -> list[View]:
        """Track one view, see `Odometry.process`. The views of a time are returned when the last of them has come."""
        count = len(self._mounts)
        if self._views and self._views[0].number // count != number // count:
            self._views = []
        self._views.append(Frame(number, grey, valid))
        if len(self._views) < count:
            return []
        frames, self._views = self._views, []
        if self.tracking is not None:
            return self.tracking.track(frames)
        self._follow(frames)
        landmarks = self._initial_map()
        if landmarks is None:
            for frame in frames:
                new = replenished(frame, count)
                frame.append(self._new_ids(len(new)), new)
            return []
        self.tracking = RigTracking(landmarks, frames, self._seed)
        times, self._times = self._times, []
        return self._views_before(self.tracking, times)

    def finish(self) -> list[View]:
        """Nothing waits for the end."""
        return []

    # ---- initialisation --------------------------------------------------------------------------------------

    def _new_ids(self, count: int) -> NDArray[np.int64]:
        self._count += count
        return np.arange(self._count - count, self._count)

    def _follow(self, frames: list[Frame]) -> None:
        """Give the views the features of the time before."""
        if self._times:
            for frame, last in zip(frames, self._times[-1], strict=True):
                frame.track(last)
        self._times.append(frames)
        del self._times[:-LONGEST]

    def _initial_map(self) -> LandmarkMap | None:
        """The map of an earlier time and the last one, with times between; None if they do not make one."""
        first = self._partner()
        if first is None:
            return None
        shared, camera, pixels_a, pixels_b = self._shared(first)
        rays_a, rays_b = self._lens.rays(pixels_a), self._lens.rays(pixels_b)
        T = relative_rig_pose(self._mounts, camera, camera, rays_a, rays_b, MAX_ERROR / self._lens.focal, self._seed)
        if T is None:
            return None
        xyz, good = np.zeros((len(shared), 3)), np.zeros(len(shared), dtype=bool)
        for number, mount in enumerate(self._mounts):
            mine = camera == number
            each = mount, mount @ T, rays_a[mine], rays_b[mine]
            xyz[mine], good[mine] = triangulated(*each, 2 * MAX_ERROR / self._lens.focal, min_angle=0.5)
        if good.sum() < max(FEWEST_SHARED, 0.5 * len(shared)) or _parallax(T, xyz[good]) < LEAST_ANGLE:
            return None
        return self._mapped(first, T, shared[good], xyz[good])

    def _partner(self) -> int | None:
        """Index of the time with the largest motion to the last one, among those that share enough features with it."""
        best, best_shift = None, LEAST_SHIFT * max(self._times[-1][0].grey.shape)
        for i in range(len(self._times) - 2, -1, -1):
            shared, _, pixels_a, pixels_b = self._shared(i)
            features = sum(len(frame.ids) for frame in self._times[i])
            if len(shared) < max(FEWEST_SHARED, 0.4 * features):
                break
            shift = float(np.median(np.linalg.norm(pixels_a - pixels_b, axis=1)))
            if shift > best_shift:
                best, best_shift = i, shift
        return best

    def _shared(
        self, time: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Features that a time shares with the last one: ids (N,), camera (N,), and both pixels (N, 2)."""
        found = []
        for number, (a, b) in enumerate(zip(self._times[time], self._times[-1], strict=True)):
            ids, of_a, of_b = np.intersect1d(a.ids, b.ids, return_indices=True)
            found.append((ids, np.full(len(ids), number), a.pixels[of_a], b.pixels[of_b]))
        ids, camera, pixels_a, pixels_b = (np.concatenate(each) for each in zip(*found, strict=True))
        return ids, camera, pixels_a, pixels_b

    def _mapped(
        self, first: int, T: NDArray[np.float64], ids: NDArray[np.int64], xyz: NDArray[np.float64]
    ) -> LandmarkMap | None:
        """Build the map of two times and of some between; None if it is inconsistent."""
        landmarks, last = LandmarkMap(self._lens, self._mounts), len(self._times) - 1
        landmarks.new_ids(self._count)
        scale = 1.0 / float(np.median(np.linalg.norm(xyz, axis=1)))  # the median distance becomes 1
        landmarks.xyz[ids], landmarks.known[ids] = scale * xyz, True
        T = T.copy()
        T[:3, 3] *= scale
        poses = {first: np.eye(4), last: T}
        for i in np.unique(np.linspace(first, last, BETWEEN + 2).round().astype(int)[1:-1]).tolist():
            located = None if i in poses else localised_rig(landmarks, self._times[i], np.eye(4), self._seed)
            if located is not None:
                poses[i] = inverse_se3(self._mounts[0]) @ located[0].T_camera_world
        for i in sorted(poses):
            for frame, mount in zip(self._times[i], self._mounts, strict=True):
                rays = self._lens.rays(frame.pixels)
                landmarks.add_keyframe(
                    Keyframe(frame.number, mount @ poses[i], frame.grey, frame.ids.copy(), frame.pixels.copy(), rays)
                )
        every, count = range(len(landmarks.keyframes)), len(self._mounts)
        for steps in (30, 15):
            if not np.isfinite(landmarks.adjust(every[count:], every[:count], steps=steps)):
                return None
            landmarks.discard_outliers(every)
            for k in every:
                landmarks.triangulate(k)
        landmarks.adjust(every[count:], every[:count], steps=15)
        landmarks.discard_outliers(every)
        return landmarks if self._holds(landmarks, len(ids)) else None

    def _holds(self, landmarks: LandmarkMap, made: int) -> bool:
        """Whether the map keeps enough landmarks and has a median reprojection error below 1 px."""
        errors = [np.zeros(0)]
        for keyframe in landmarks.keyframes:
            known = landmarks.known[keyframe.ids]
            errors.append(ray_errors(keyframe.T_camera_world, landmarks.xyz[keyframe.ids[known]], keyframe.rays[known]))
        median = float(np.median(np.concatenate(errors))) * landmarks.lens.focal
        return landmarks.known.sum() >= max(FEWEST_SHARED // 2, 0.5 * made) and median < 1.0

    def _views_before(self, tracking: RigTracking, times: Sequence[list[Frame]]) -> list[View]:
        """Localise the times before the last one by their features, from the first keyframe back and on."""
        landmarks, T_rig_face = tracking.map, inverse_se3(self._mounts[0])
        places = {each.number: each for each in landmarks.keyframes}
        start = next(i for i, frames in enumerate(times) if frames[0].number in places)
        found: dict[int, list[LocalisedFrame]] = {}
        for order in (range(start - 1, -1, -1), range(start, len(times))):
            T = T_rig_face @ landmarks.keyframes[0].T_camera_world
            for i in order:
                frames = times[i]
                if frames[0].number in places:
                    located = [
                        LocalisedFrame(f.number, f.grey, f.valid, at.ids, at.pixels, T_camera_world=at.T_camera_world)
                        for f, at in ((frame, places[frame.number]) for frame in frames)
                    ]
                else:
                    located = localised_rig(landmarks, frames, T, self._seed)
                if located is not None:
                    T, found[i] = T_rig_face @ located[0].T_camera_world, located
        return [view for i in sorted(found) for view in tracking.views(found[i])]


def _parallax(T_b_a: NDArray[np.float64], xyz: NDArray[np.float64]) -> float:
    """Median angle [degrees] between the rays of points (N, 3) from two places; xyz is in the frame of a."""
    centre = -T_b_a[:3, :3].T @ T_b_a[:3, 3]
    b = xyz - centre
    cosine = (xyz * b).sum(axis=1) / (np.linalg.norm(xyz, axis=1) * np.linalg.norm(b, axis=1))
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))
