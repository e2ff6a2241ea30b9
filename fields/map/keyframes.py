"""Keyframes, and frames between them: the views that the map is optimised on."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.camera_revision import CameraRevision
from fields.frames.pyramid import ImageLevel, build_pyramid
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import interpolate_se3, inverse_se3, orthonormalised
from fields.geometry.similarity import moved_points, scale_of
from fields.map.running_median import RunningMedian
from fields.map.trajectory import Trajectory

__all__ = ["NO_MOTION", "Keyframe", "KeyframeStore"]


def _unchanging(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """Make a default value read-only, so that all keyframes can share it. A long recording has thousands."""
    array.flags.writeable = False
    return array


NO_MOTION = _unchanging(np.eye(4))
NO_POSE_MOMENT = _unchanging(np.zeros(6))
NO_EXPOSURE_MOMENT = _unchanging(np.zeros((3, 4)))


@dataclass(slots=True)
class Keyframe:
    """One keyframe, or a frame between keyframes. Images stay in host memory with 8 bits per channel.

    Arrays are replaced and never modified in place, since views may share them.

    Attributes:
        index: Index of the frame.
        rgba: Image (H, W, 4) uint8; the last channel is 255 at valid pixels, and between 0 and 255 at the edge of
            what moves.
        camera: Camera of `rgba`.
        trajectory: The tracked poses of all frames.
        T_camera_world: Refined pose (4, 4).
        points: Tracked points.
        median_depth: Median depth of the tracked points [scene units].
        error: Mean absolute error when the keyframe was last optimised, err(j) of Eq. 2.
        pyramid: Images at halved sizes, the first at the size of `rgba`.
        pose_m: First moment (6,) of Adam on the pose.
        pose_v: Second moment (6,) of Adam on the pose.
        pose_steps: Number of Adam steps of the pose.
        vignette: Vignette as in `TrackedFrame`, at full size.
        exposure: Affine colour transform (A, b) (3, 4), image = (A colour + b) vignette; None if exposure is not
            estimated.
        exposure_m: First moment (3, 4) of Adam on the exposure.
        exposure_v: Second moment (3, 4) of Adam on the exposure.
        exposure_steps: Number of Adam steps of the exposure.
        pending_motion: Similarity (4, 4) of the world around the keyframe, by the tracker's corrections, that its
            Gaussians have not followed yet.
        is_between: Whether it is a frame between keyframes. The map is optimised on it as on a keyframe, but gets only
            its tracked points.
        transient: Weights (h, w) uint8 of the parts of the image that move, on a coarse grid: 0 where the image shows
            something that moves, 255 elsewhere. None if nothing moves. `rgba` and `pyramid` contain them.
        unmasked: The pyramid without these weights; empty if nothing moves.
        missing: Number of Gaussians in blocks on disk that it sees, see `pipelines.blocks`.
    """

    index: int
    rgba: NDArray[np.uint8]
    camera: PinholeCamera
    trajectory: Trajectory = field(repr=False)
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
    is_between: bool = False
    transient: NDArray[np.uint8] | None = None
    unmasked: tuple[ImageLevel, ...] = ()
    missing: int = 0

    @property
    def image_bytes(self) -> int:
        """Bytes of the images in memory."""
        return sum(image.nbytes for image in (*self.pyramid, *self.unmasked))

    @property
    def nbytes(self) -> int:
        """Bytes of the images and tracked points in memory."""
        return _nbytes((*self.pyramid, *self.unmasked), self.points)

    @property
    def centre(self) -> NDArray[np.float64]:
        """Centre (3,) of the camera in the world frame, by the refined pose."""
        return inverse_se3(self.T_camera_world)[:3, 3]

    @property
    def view_scale(self) -> float:
        """Width of a pixel at the median depth, median_depth / focal [scene units] (Section 3.2.1)."""
        return self.median_depth / self.camera.focal

    def image(self, level: int) -> ImageLevel:
        """Return the image of a pyramid level, or the coarsest one if there are fewer levels."""
        return self.pyramid[min(level, len(self.pyramid) - 1)]

    def whole_image(self, level: int) -> ImageLevel:
        """Return `image(level)` without the weights of `transient`."""
        pyramid = self.unmasked or self.pyramid
        return pyramid[min(level, len(pyramid) - 1)]

    def mask(self, transient: NDArray[np.uint8] | None) -> None:
        """Replace `transient`, and weight the images by it."""
        whole = self.unmasked or self.pyramid
        self.transient = transient
        self.unmasked = () if transient is None else whole
        self.pyramid = whole if transient is None else tuple(_weighted(image, transient) for image in whole)
        self.rgba = self.pyramid[0].rgba

    def at_level(self, level: int) -> Keyframe:
        """Return a read-only copy of this view at a pyramid level."""
        image = self.image(level)
        scale = np.array([image.camera.width / self.camera.width, image.camera.height / self.camera.height])
        points = replace(self.points, pixels=self.points.pixels * scale)
        return replace(self, rgba=image.rgba, camera=image.camera, points=points, pyramid=(image,))

    @property
    def T_tracked(self) -> NDArray[np.float64]:  # noqa: N802  # a transform is named by its ends
        """Pose T_camera_world (4, 4) from the tracker, with all of its corrections so far."""
        return self.trajectory[self.index]

    @property
    def correction(self) -> NDArray[np.float64]:
        """Rigid motion (4, 4) that refinement applied on the left of the tracked pose."""
        return self.T_camera_world @ inverse_se3(self.T_tracked)

    def follow(self, T_before: NDArray[np.float64], S: NDArray[np.float64]) -> None:
        """Follow the tracked pose after the tracker has revised it.

        The refinement of the pose is kept, with its translation scaled by S. Adam's moments are kept unchanged, since
        they are in pixels of this camera. The tracked points and the median depth move with the world.

        Args:
            T_before: Tracked pose T_camera_world (4, 4) before the revision.
            S: Similarity S_after_before (4, 4) of the world around the keyframe.
        """
        T_tracked = self.T_tracked
        if np.array_equal(S, np.eye(4)) and np.array_equal(T_tracked, T_before):
            return
        correction = self.T_camera_world @ inverse_se3(T_before)
        correction[:3, 3] *= scale_of(S)
        unrefined = np.array_equal(self.T_camera_world, T_before)
        self.T_camera_world = T_tracked.copy() if unrefined else orthonormalised(correction @ T_tracked)
        self.points = replace(self.points, xyz=moved_points(S, self.points.xyz))
        self.median_depth *= float(scale_of(S))
        self.pending_motion = S @ self.pending_motion

    def revise_camera(self, revision: CameraRevision, vignette: NDArray[np.float32] | None) -> None:
        """Take a new camera: the image with its pyramid, the vignette and the tracked points change with it.

        The points keep their depths at the tracked pose. Those whose pixels leave the image are dropped, and so is the
        mask of what moves.

        Args:
            revision: The new camera.
            vignette: The vignette of its images.
        """
        self.mask(None)
        T, points, rgba = self.T_tracked, self.points, revision.image(self.rgba)
        there = revision.points(points.xyz @ T[:3, :3].T + T[:3, 3], self.camera)
        pixels = revision.pixels(points.pixels)
        kept = revision.camera.contains(pixels)
        self.points = SparsePoints((there[kept] - T[:3, 3]) @ T[:3, :3], pixels[kept], points.ids[kept])
        self.pyramid = build_pyramid(rgba, revision.camera, len(self.pyramid))
        self.rgba, self.camera, self.vignette = rgba, revision.camera, vignette

    def revise_points(self, points: SparsePoints) -> None:
        """Replace the tracked points by the tracker's revised ones, and update the median depth."""
        self.points = points
        self.median_depth = _median_depth(points, self.T_tracked, self.median_depth)


def _median_depth(points: SparsePoints, T_camera_world: NDArray[np.float64], otherwise: float) -> float:
    """Median depth of the points in front of the camera; `otherwise` if there are none."""
    depth = points.depths(T_camera_world)
    depth = depth[depth > 0]
    return float(np.median(depth)) if len(depth) else otherwise


def _weighted(image: ImageLevel, weights: NDArray[np.uint8]) -> ImageLevel:
    """Multiply the validity of an image by weights (h, w) of any size, 0 to 255."""
    size = (image.camera.width, image.camera.height)
    fine = np.asarray(cv2.resize(weights, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
    rgba = image.rgba.copy()
    rgba[..., 3] = np.where(rgba[..., 3] == 255, fine, rgba[..., 3])
    return ImageLevel(rgba, image.camera)


def _nbytes(pyramid: Iterable[ImageLevel], points: SparsePoints) -> int:
    return sum(image.nbytes for image in pyramid) + sum(a.nbytes for a in (points.xyz, points.pixels, points.ids))


class KeyframeStore:
    """The keyframes, and frames between them, in the order of their frames.

    The cost of the per-frame operations does not grow with the number of keyframes, except for `errors`, which takes a
    few microseconds.

    Attributes:
        trajectory: The tracked poses of all frames, those of the keyframes included.
        selected: The keyframes without the frames between them.
        latest: Place of the last of these in the store; -1 without keyframes.
        views: Number of views that are taken at one time, as in `TrackedFrame`.
        nbytes: Bytes of the keyframes' images and points.
        most_missing: Number of Gaussians on disk that a keyframe may see and still be drawn as a view.
    """

    def __init__(self, levels: int = 1, min_side: int = 1, trajectory: Trajectory | None = None) -> None:
        """Create an empty store.

        Args:
            levels: Number of pyramid levels that a keyframe keeps.
            min_side: Minimum side length of all levels but the first [px].
            trajectory: The tracked poses of all frames; None for a new one.
        """
        self.levels = levels
        self.min_side = min_side
        self.trajectory = Trajectory() if trajectory is None else trajectory
        self._keyframes: list[Keyframe] = []
        self.selected: list[Keyframe] = []
        self.latest = -1
        self.views = 1
        self._depths = RunningMedian()
        self.nbytes = 0
        self.most_missing = 0

    def __len__(self) -> int:
        return len(self._keyframes)

    def __getitem__(self, i: int) -> Keyframe:
        return self._keyframes[i]

    def __iter__(self) -> Iterator[Keyframe]:
        return iter(self._keyframes)

    @property
    def scene_depth(self) -> float:
        """Median over the keyframes of the median depth of their tracked points, the unit of length of the settings."""
        return self._depths.value if len(self._depths) else 1.0

    def bytes_of(self, frame: TrackedFrame) -> int:
        """Return the number of bytes that a frame would take as a keyframe."""
        return _nbytes(self._kept(frame, self.levels), frame.points)

    def before(self, index: int, count: int) -> list[Keyframe]:
        """Return up to `count` keyframes of the same view before frame `index`, in order, without those between."""
        found: list[Keyframe] = []
        for keyframe in reversed(self.selected):
            if len(found) == count:
                break
            if keyframe.index < index and self._of_one_view(keyframe.index, index):
                found.append(keyframe)
        return found[::-1]

    def _of_one_view(self, a: int, b: int) -> bool:
        """Whether frames a and b show one of the views that are taken at one time."""
        return (a - b) % self.views == 0

    def errors(self) -> NDArray[np.float64]:
        """Return the errors (N,) of all keyframes."""
        return np.fromiter((k.error for k in self._keyframes), np.float64, len(self._keyframes))

    def _kept(self, frame: TrackedFrame, levels: int) -> tuple[ImageLevel, ...]:
        """First `levels` levels of a frame's pyramid, except those that are smaller than `min_side`."""
        first, *others = frame.pyramid[:levels]
        return (first, *(o for o in others if min(o.camera.width, o.camera.height) >= self.min_side))

    def append(self, frame: TrackedFrame, is_between: bool = False) -> Keyframe:
        """Add a frame as a keyframe. Its error starts at the mean of the others (1 for the first keyframe).

        Args:
            frame: The frame.
            is_between: Whether it is a frame between keyframes.
        """
        self.trajectory.add(frame)
        self.views = frame.views
        keyframe = self.view(frame, self.levels)
        keyframe.is_between = is_between
        self._keyframes.append(keyframe)
        if not is_between:
            self.selected.append(keyframe)
            self.latest = len(self._keyframes) - 1
        self.nbytes += keyframe.nbytes
        self._depths.add(keyframe.median_depth)
        return keyframe

    def revise_camera(self, revision: CameraRevision) -> None:
        """Replace the camera of all keyframes, see `Keyframe.revise_camera`."""
        revised: dict[int, NDArray[np.float32]] = {}  # vignettes, of which all keyframes mostly share one
        for keyframe in self._keyframes:
            vignette = keyframe.vignette
            if vignette is not None and id(vignette) not in revised:
                revised[id(vignette)] = revision.vignette(vignette)
            keyframe.revise_camera(revision, None if vignette is None else revised[id(vignette)])
        self.nbytes = sum(keyframe.nbytes for keyframe in self._keyframes)

    def mask(self, keyframe: Keyframe, transient: NDArray[np.uint8] | None) -> None:
        """Replace the mask of what moves in a keyframe of the store, see `Keyframe.mask`."""
        self.nbytes -= keyframe.nbytes
        keyframe.mask(transient)
        self.nbytes += keyframe.nbytes

    def move_images(self, keyframe: Keyframe, stored: Callable[[Sequence[ImageLevel]], list[ImageLevel]]) -> None:
        """Replace the images of a keyframe of the store by equal ones.

        Args:
            keyframe: The keyframe.
            stored: Returns such images for images, in order.
        """
        self.nbytes -= keyframe.nbytes
        count = len(keyframe.pyramid)
        moved = stored([*keyframe.pyramid, *keyframe.unmasked])
        keyframe.pyramid, keyframe.unmasked = tuple(moved[:count]), tuple(moved[count:])
        keyframe.rgba = keyframe.pyramid[0].rgba
        self.nbytes += keyframe.nbytes

    def near(self) -> NDArray[np.int64]:
        """Return the places (M,) of the keyframes that miss at most `most_missing` Gaussians."""
        missing = np.fromiter((k.missing for k in self._keyframes), np.int64, len(self._keyframes))
        return np.flatnonzero(missing <= self.most_missing)

    def take_in_depths(self) -> None:
        """Recompute `scene_depth` after median depths have changed."""
        self._depths = RunningMedian()
        for keyframe in self._keyframes:
            self._depths.add(keyframe.median_depth)

    def view(self, frame: TrackedFrame, levels: int = 1) -> Keyframe:
        """Return a frame as a keyframe, without adding it to the store.

        Pose and exposure are interpolated between the surrounding keyframes, see `corrected` and `exposure_at`.

        Args:
            frame: The frame.
            levels: Number of pyramid levels.
        """
        return Keyframe(
            index=frame.index,
            rgba=frame.rgba,
            camera=frame.camera,
            trajectory=self.trajectory,
            T_camera_world=self.corrected(frame.index, frame.T_camera_world),
            points=frame.points,
            median_depth=_median_depth(frame.points, frame.T_camera_world, self.scene_depth),
            error=float(self.errors().mean()) if self._keyframes else 1.0,
            vignette=frame.vignette,
            exposure=self.exposure_at(frame.index),
            pyramid=self._kept(frame, levels),
        )

    def corrected(self, index: int, T_tracked: NDArray[np.float64]) -> NDArray[np.float64]:
        """Apply the refinement of the surrounding keyframes to a tracked pose (Section 3.3.3).

        The correction is interpolated by frame index between the keyframes of the same view before and after the frame.
        Outside the range of the keyframes, that of the nearest one is used. A view without keyframes stays as tracked.

        Args:
            index: Index of the frame.
            T_tracked: Tracked pose T_camera_world (4, 4).

        Returns:
            Corrected pose T_camera_world (4, 4).
        """
        if not self._keyframes:
            return np.array(T_tracked, dtype=np.float64)
        a, b, t = self._around(index)
        if not self._of_one_view(a.index, index):  # its correction has other axes
            return np.array(T_tracked, dtype=np.float64)
        if a is b:
            return a.correction @ T_tracked
        return interpolate_se3(a.correction, b.correction, t) @ T_tracked

    def exposure_at(self, index: int) -> NDArray[np.float64] | None:
        """Interpolate the exposure (3, 4) of frame `index` between the surrounding keyframes, as for poses.

        Returns None if exposure is not estimated.
        """
        if not self._keyframes:
            return None
        a, b, t = self._around(index)
        if a.exposure is None or b.exposure is None:
            return None
        return (1.0 - t) * a.exposure + t * b.exposure

    def _around(self, index: int) -> tuple[Keyframe, Keyframe, float]:
        """Keyframes of its view before and after frame `index`, and its position between; outside, twice the nearest.

        A view without keyframes takes those of any.
        """
        every = self._keyframes
        if self.views > 1:
            every = [each for each in every if self._of_one_view(each.index, index)] or every
        after = bisect_left(every, index, key=lambda keyframe: keyframe.index)
        if after == 0 or after == len(every):
            nearest = every[min(after, len(every) - 1)]
            return nearest, nearest, 0.0
        a, b = every[after - 1], every[after]
        return a, b, (index - a.index) / (b.index - a.index)
