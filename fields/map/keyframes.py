"""Keyframes: what the map keeps of the frames that it is optimised on."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fields.frames.pyramid import ImageLevel
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import interpolate_se3, inverse_se3, orthonormalised
from fields.geometry.similarity import moved_points, scale_of
from fields.map.running_median import RunningMedian

__all__ = ["NO_MOTION", "Keyframe", "KeyframeStore"]


def _unchanging(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """One array for all keyframes whose value it still is: a long recording has thousands."""
    array.flags.writeable = False
    return array


NO_MOTION = _unchanging(np.eye(4))
NO_POSE_MOMENT = _unchanging(np.zeros(6))
NO_EXPOSURE_MOMENT = _unchanging(np.zeros((3, 4)))


@dataclass(slots=True)
class Keyframe:
    """One keyframe. Images stay in host memory with 8 bits a channel.

    index: of its frame. rgba: (H, W, 4) uint8, the image and 255 where it is valid; camera: of that image. pyramid:
    the same at halved sizes, itself first. T_tracked: the tracker's T_camera_world; T_camera_world: the refined one.
    median_depth: of its tracked points [scene units]; view_scale:
    median_depth / focal, the width of a pixel out there (Section 3.2.1). error: mean absolute error when the frame was
    optimised last (err(j) of Eq. 2). vignette: as in `TrackedFrame`, at full size. exposure: (3, 4) affine colour
    transform (A, b), image = (A colour + b) vignette; None for an identity that is not estimated. pending_motion: the
    motion (4, 4) of the world around it, by corrections of the tracker, that its Gaussians have not followed yet.

    Arrays are replaced, never written into: they may be other views' as well.
    """

    index: int
    rgba: NDArray[np.uint8]
    camera: PinholeCamera
    T_tracked: NDArray[np.float64]
    T_camera_world: NDArray[np.float64]
    points: SparsePoints
    median_depth: float
    error: float
    pyramid: tuple[ImageLevel, ...] = ()
    pose_m: NDArray[np.float64] = field(default_factory=lambda: NO_POSE_MOMENT)
    pose_v: NDArray[np.float64] = field(default_factory=lambda: NO_POSE_MOMENT)
    pose_steps: int = 0
    vignette: NDArray[np.float32] | None = None
    exposure: NDArray[np.float64] | None = None
    exposure_m: NDArray[np.float64] = field(default_factory=lambda: NO_EXPOSURE_MOMENT)
    exposure_v: NDArray[np.float64] = field(default_factory=lambda: NO_EXPOSURE_MOMENT)
    exposure_steps: int = 0
    pending_motion: NDArray[np.float64] = field(default_factory=lambda: NO_MOTION)

    @property
    def view_scale(self) -> float:
        return self.median_depth / self.camera.focal

    def image(self, level: int) -> ImageLevel:
        """The image of a pyramid level; the coarsest where there are fewer."""
        return self.pyramid[min(level, len(self.pyramid) - 1)]

    def at_level(self, level: int) -> Keyframe:
        """This view with the image of a pyramid level, for reading only."""
        image = self.image(level)
        scale = np.array([image.camera.width / self.camera.width, image.camera.height / self.camera.height])
        points = replace(self.points, pixels=self.points.pixels * scale)
        return replace(self, rgba=image.rgba, camera=image.camera, points=points, pyramid=(image,))

    @property
    def correction(self) -> NDArray[np.float64]:
        """The motion (4, 4) that refinement has put on the left of the tracked pose."""
        return self.T_camera_world @ inverse_se3(self.T_tracked)

    def revise(self, T_tracked: NDArray[np.float64], S: NDArray[np.float64]) -> None:
        """Take over the tracker's revised pose (4, 4), S_after_before (4, 4) being how the world around it moves.

        What refinement has put on the tracked pose stays on it, at the scale of S, and so do Adam's moments, which are
        in pixels of this camera. The tracked points and their depths move with the world.
        """
        if np.array_equal(S, np.eye(4)) and np.array_equal(T_tracked, self.T_tracked):
            return
        correction = self.correction
        correction[:3, 3] *= scale_of(S)
        unrefined = np.array_equal(self.T_camera_world, self.T_tracked)
        self.T_tracked = T_tracked.copy()
        self.T_camera_world = T_tracked.copy() if unrefined else orthonormalised(correction @ T_tracked)
        self.points = replace(self.points, xyz=moved_points(S, self.points.xyz))
        self.median_depth *= float(scale_of(S))
        self.pending_motion = S @ self.pending_motion

    def revise_points(self, points: SparsePoints) -> None:
        """Take over the tracker's revised points."""
        self.points = points
        self.median_depth = _median_depth(points, self.T_tracked, self.median_depth)


def _median_depth(points: SparsePoints, T_camera_world: NDArray[np.float64], otherwise: float) -> float:
    """Median depth of the points before the camera; `otherwise` where there are none."""
    depth = points.depths(T_camera_world)
    depth = depth[depth > 0]
    return float(np.median(depth)) if len(depth) else otherwise


def _nbytes(pyramid: tuple[ImageLevel, ...], points: SparsePoints) -> int:
    return sum(image.rgba.nbytes for image in pyramid) + sum(a.nbytes for a in (points.xyz, points.pixels, points.ids))


class KeyframeStore:
    """The keyframes in the order of their frames.

    What is asked of it frame by frame takes no longer with a thousand keyframes than with ten, but for `errors`, which
    are a few microseconds.
    """

    def __init__(self, levels: int = 1, min_side: int = 1) -> None:
        """levels: of the keyframes' image pyramids; all but the first have sides of at least min_side [px]."""
        self.levels = levels
        self.min_side = min_side
        self._keyframes: list[Keyframe] = []
        self._depths = RunningMedian()
        self.nbytes = 0  # of the keyframes' images and points

    def __len__(self) -> int:
        return len(self._keyframes)

    def __getitem__(self, i: int) -> Keyframe:
        return self._keyframes[i]

    def __iter__(self) -> Iterator[Keyframe]:
        return iter(self._keyframes)

    @property
    def scene_depth(self) -> float:
        """Median over the keyframes of the median depth of their tracked points: the unit of all lengths."""
        return self._depths.value if len(self._depths) else 1.0

    def bytes_of(self, frame: TrackedFrame) -> int:
        """Bytes that a frame would take as a keyframe."""
        return _nbytes(self._kept(frame, self.levels), frame.points)

    def errors(self) -> NDArray[np.float64]:
        """The keyframes' errors (N,)."""
        return np.fromiter((k.error for k in self._keyframes), np.float64, len(self._keyframes))

    def _kept(self, frame: TrackedFrame, levels: int) -> tuple[ImageLevel, ...]:
        """The first `levels` levels of a frame's pyramid, without those that are too small."""
        first, *others = frame.pyramid[:levels]
        return (first, *(o for o in others if min(o.camera.width, o.camera.height) >= self.min_side))

    def append(self, frame: TrackedFrame) -> Keyframe:
        """Keep `frame`. It starts at the mean error of the others (1 for the first), so that it is drawn soon."""
        keyframe = self.view(frame, self.levels)
        self._keyframes.append(keyframe)
        self.nbytes += _nbytes(keyframe.pyramid, keyframe.points)
        self._depths.add(keyframe.median_depth)
        return keyframe

    def take_in_depths(self) -> None:
        """Bring the scene's depth up to date with keyframes whose median depths have changed."""
        self._depths = RunningMedian()
        for keyframe in self._keyframes:
            self._depths.add(keyframe.median_depth)

    def view(self, frame: TrackedFrame, levels: int = 1) -> Keyframe:
        """`frame` as a keyframe would be, with the pose and exposure that those around it imply, but not kept."""
        return Keyframe(
            index=frame.index,
            rgba=frame.rgba,
            camera=frame.camera,
            T_tracked=frame.T_camera_world,
            T_camera_world=self.corrected(frame.index, frame.T_camera_world),
            points=frame.points,
            median_depth=_median_depth(frame.points, frame.T_camera_world, self.scene_depth),
            error=float(self.errors().mean()) if self._keyframes else 1.0,
            vignette=frame.vignette,
            exposure=self.exposure_at(frame.index),
            pyramid=self._kept(frame, levels),
        )

    def corrected(self, index: int, T_tracked: NDArray[np.float64]) -> NDArray[np.float64]:
        """T_camera_world (4, 4) of frame `index`: its tracked pose with the corrections of the keyframes around it.

        The correction is interpolated between the two by frame index, and the nearest one's outside (Section 3.3.3).
        """
        if not self._keyframes:
            return np.array(T_tracked, dtype=np.float64)
        a, b, t = self._around(index)
        if a is b:
            return a.correction @ T_tracked
        return interpolate_se3(a.correction, b.correction, t) @ T_tracked

    def exposure_at(self, index: int) -> NDArray[np.float64] | None:
        """Exposure (3, 4) of frame `index`: interpolated between those of the keyframes around it, as poses are.

        None where exposure is not estimated.
        """
        if not self._keyframes:
            return None
        a, b, t = self._around(index)
        if a.exposure is None or b.exposure is None:
            return None
        return (1.0 - t) * a.exposure + t * b.exposure

    def _around(self, index: int) -> tuple[Keyframe, Keyframe, float]:
        """The keyframes before and after frame `index`, and its place between them; twice the nearest one outside."""
        after = bisect_left(self._keyframes, index, key=lambda keyframe: keyframe.index)
        if after == 0 or after == len(self._keyframes):
            nearest = self._keyframes[min(after, len(self._keyframes) - 1)]
            return nearest, nearest, 0.0
        a, b = self._keyframes[after - 1], self._keyframes[after]
        return a, b, (index - a.index) / (b.index - a.index)
