"""`Search`: the pose of one undistorted picture in a map, by features, by rendering, and a judgement of the result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints
from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.multiview.features import Features, detect_features
from modp_ti.outputs.locating.likeness import likeness
from modp_ti.outputs.locating.map_views import MIN_OPACITY, MapViews, matched, rendered_features
from modp_ti.outputs.locating.resection import Resection, pose_covariance, reprojection_errors, resect
from modp_ti.outputs.playback.map_renderer import MapRenderer, eight_bits
from pipelines.optimise.view_alignment import ViewAlignment

__all__ = ["Found", "Search"]

# Largest reprojection errors of inliers [px]: of matches with the map's views, and with a render from the pose.
MAX_ERROR, MAX_ERROR_THERE = 3.0, 2.0
# Fewest inliers of the two.
FEWEST, FEWEST_THERE = 12, 20
# Renders from the estimated pose before the photometric refinement. From the first one, the features may still be seen
# from too different a place.
ROUNDS = 2
# Least likeness of the picture and the render.
LIKE = 0.6


@dataclass(frozen=True)
class Found:
    """A pose that the search has found.

    Attributes:
        T_camera_world: Pose (4, 4).
        camera: The camera, with the estimated focal length if it was estimated.
        inliers: Features that the picture and the render from the pose show at the same place.
        likeness: Likeness of the two.
        covariance: (6, 6), see `pose_covariance`.
    """

    T_camera_world: NDArray[np.float64]
    camera: PinholeCamera
    inliers: int
    likeness: float
    covariance: NDArray[np.float64]


class Search:
    """Searches for pictures in a map.

    Args:
        renderer: Renders the map.
        views: Features of the map.
        seed: Seed of RANSAC.
    """

    def __init__(self, renderer: MapRenderer, views: MapViews, seed: int = 0) -> None:
        self._renderer = renderer
        self._views = views
        self._seed = seed
        self._alignment = ViewAlignment(renderer.renderer, renderer.near)

    def find(
        self,
        image: NDArray[np.float32],
        valid: NDArray[np.bool_] | None,
        camera: PinholeCamera,
        estimate_focal: bool = False,
    ) -> Found | str:
        """Find the pose of a picture.

        Args:
            image: Undistorted picture (H, W, 3) in [0, 1].
            valid: Its valid pixels (H, W); None for all.
            camera: Its camera.
            estimate_focal: Whether to estimate the focal length, from that of `camera`.

        Returns:
            What was found, or why nothing was.
        """
        valid = np.ones(image.shape[:2], dtype=bool) if valid is None else valid
        features = detect_features(eight_bits(image)).within(valid)
        xyz, pixels = self._views.matches(features)
        found = resect(xyz, pixels, camera, MAX_ERROR, self._seed, estimate_focal)
        if found is None or np.count_nonzero(found.inlier) < FEWEST:
            return "too few of its features are those of the map"
        for _ in range(ROUNDS):
            xyz, pixels = matched(rendered_features(self._renderer, found.camera, found.T_camera_world), features)
            found = resect(xyz, pixels, found.camera, MAX_ERROR_THERE, self._seed, estimate_focal)
            if found is None or np.count_nonzero(found.inlier) < FEWEST_THERE:
                return "the map does not show its features from where they seem to be seen"
        T = self._alignment.refine(image, valid, found.camera, found.T_camera_world, _seen(xyz, pixels, found))
        return self._judged(T, found.camera, features, image, valid)

    def _judged(
        self,
        T: NDArray[np.float64],
        camera: PinholeCamera,
        features: Features,
        image: NDArray[np.float32],
        valid: NDArray[np.bool_],
    ) -> Found | str:
        """Compare the picture with the render from a pose. Returns why the pose cannot be right, if it cannot."""
        xyz, pixels = matched(rendered_features(self._renderer, camera, T), features)
        inlier = reprojection_errors(T, xyz, pixels, camera) <= MAX_ERROR_THERE
        # A place with several orientations is several features.
        inliers = len(np.unique(pixels[inlier], axis=0))
        if inliers < FEWEST_THERE:
            return f"from there, the map shows only {inliers} of its features at their places"
        view = self._renderer.view(camera, T)
        alike = likeness(view.colour, image, valid & (view.opacity > MIN_OPACITY))
        if alike < LIKE:
            return f"from there, the map does not look like it (likeness {alike:.2f}, at least {LIKE})"
        return Found(T, camera, inliers, alike, pose_covariance(T, xyz[inlier], pixels[inlier], camera))


def _seen(xyz: NDArray[np.float64], pixels: NDArray[np.float64], found: Resection) -> SparsePoints:
    """The inliers as the points of a view."""
    inside = found.inlier & found.camera.contains(pixels)
    return SparsePoints(xyz[inside], pixels[inside], np.flatnonzero(inside))
