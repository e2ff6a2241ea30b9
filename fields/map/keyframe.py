"""One view of those that the map is optimised on: a keyframe, or a frame between keyframes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import CameraRevision
from fields.frames.tracked_frame import ImageLevel, SparsePoints, build_pyramid
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3, moved_points, orthonormalised, scale_of
from fields.map.trajectory import Trajectory


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
        best_error: The least one that it has had at full size; inf before the first.
        depth_deviation: As in `TrackedFrame`.
        pyramid: Images at halved sizes, the first at the size of `rgba`.
        vignette: Vignette as in `TrackedFrame`, at full size.
        exposure: Affine colour transform (A, b) (3, 4), image = (A colour + b) vignette; None if exposure is not
            estimated.
        is_between: Whether it is a frame between keyframes. The map is optimised on it as on a keyframe, but gets only
            its tracked points.
        transient: Weights (h, w) uint8 of the parts of the image that move, on a coarse grid: 0 where the image shows
            something that moves, 255 elsewhere. None if nothing moves. `rgba` and `pyramid` contain them.
        unmasked: The pyramid without these weights; empty if nothing moves.
    """

    index: int
    rgba: NDArray[np.uint8]
    camera: PinholeCamera
    trajectory: Trajectory = field(repr=False)
    T_camera_world: NDArray[np.float64]
    points: SparsePoints
    median_depth: float
    error: float
    best_error: float = float("inf")
    depth_deviation: float | None = None
    pyramid: tuple[ImageLevel, ...] = ()
    vignette: NDArray[np.float32] | None = None
    exposure: NDArray[np.float64] | None = None
    is_between: bool = False
    transient: NDArray[np.uint8] | None = None
    unmasked: tuple[ImageLevel, ...] = ()

    def note_error(self, error: float, level: int = 0) -> None:
        """Take in the mean absolute error of a render at a pyramid level."""
        self.error = error
        if level == 0:
            self.best_error = min(self.best_error, error)

    @property
    def image_bytes(self) -> int:
        """Bytes of the images in memory."""
        return sum(image.nbytes for image in (*self.pyramid, *self.unmasked))

    @property
    def nbytes(self) -> int:
        """Bytes of the images and tracked points in memory."""
        return nbytes_of((*self.pyramid, *self.unmasked), self.points)

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

        The refinement of the pose is kept, with its translation scaled by S. The tracked points and the median depth
        move with the world.

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

    def revise_camera(self, revision: CameraRevision, vignette: NDArray[np.float32] | None) -> None:
        """Take a new camera: the image with its pyramid, the vignette and the tracked points change with it.

        The points keep their depths at the tracked pose. Those whose pixels leave the image are dropped, and so is the
        mask of what moves.
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
        self.median_depth = median_depth_of(points, self.T_tracked, self.median_depth)


def median_depth_of(points: SparsePoints, T_camera_world: NDArray[np.float64], otherwise: float) -> float:
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


def nbytes_of(pyramid: Iterable[ImageLevel], points: SparsePoints) -> int:
    """Return the number of bytes of a view's images and points."""
    return sum(image.nbytes for image in pyramid) + sum(a.nbytes for a in (points.xyz, points.pixels, points.ids))
