"""`Search`: the pose of one undistorted picture in a map, by features, by rendering, and a judgement of the result."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints
from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.multiview.appearance import Appearance
from modp_ti.inputs.multiview.features import Features, detect_features, match_anywhere
from modp_ti.inputs.multiview.reprojection import pixel_errors
from modp_ti.outputs.formats.mesh import without_edges
from modp_ti.outputs.locating.resection import Resection, pose_covariance, resect
from modp_ti.outputs.playback.map_renderer import MapRenderer, eight_bits
from pipelines.optimise.poses import ViewAlignment
from pipelines.render.renderer import RenderedView

# Standard deviations [px] of the blurs between which structures count: coarser than the detail that a map lacks, finer
# than light and shade.
FINE, COARSE = 1.5, 8.0
MIN_PIXELS = 1000
# A feature has a place if the map is this opaque there.
MIN_OPACITY = 0.9
# Views that are matched with a picture.
CANDIDATES = 8
PlacedFeatures = tuple[Features, NDArray[np.float64]]
"""Features of a render, and their world points (N, 3)."""
# Largest reprojection errors of inliers [px]: of matches with the map's views, and with a render from the pose.
MAX_ERROR, MAX_ERROR_THERE = 3.0, 2.0
# Fewest inliers of the two.
FEWEST, FEWEST_THERE = 12, 20
# Renders from the estimated pose before the photometric refinement. From the first one, the features may still be seen
# from too different a place.
ROUNDS = 2
# Least likeness of the picture and the render.
LIKE = 0.6


def likeness(render: NDArray[np.floating], image: NDArray[np.floating], valid: NDArray[np.bool_]) -> float:
    """Correlation of a band of the grey render and the grey image.

    Args:
        render: Rendered colour (H, W, 3).
        image: Observed colour (H, W, 3).
        valid: Pixels that count (H, W).

    Returns:
        From -1 to 1; 0 if fewer than 1000 pixels count, or one of them has no structure.
    """
    if np.count_nonzero(valid) < MIN_PIXELS:
        return 0.0
    a, b = (_band(picture, valid)[valid] for picture in (render, image))
    length = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / length if length > 0 else 0.0


def _band(picture: NDArray[np.floating], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The band (H, W) of the mean of the colours. Other pixels do not enter the blur."""
    weight = valid.astype(np.float64)
    grey = picture.astype(np.float64).mean(axis=2) * weight

    def blurred(sigma: float) -> NDArray[np.float64]:
        share = np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-6)
        return np.asarray(cv2.GaussianBlur(grey, (0, 0), sigma) / share)

    return blurred(FINE) - blurred(COARSE)


class MapViews:
    """Renders of a map from several poses, with their features.

    The images of the run are not needed. On redkitchen, features of renders locate pictures as well as those of the
    images: with a median error of 1.7 mm instead of 1.9 mm.

    Args:
        renderer: Renders the map.
        shots: Camera and T_camera_world (4, 4) of each view.
    """

    def __init__(self, renderer: MapRenderer, shots: Iterable[tuple[PinholeCamera, NDArray[np.float64]]]) -> None:
        self._views = [_rendered_features(renderer, camera, T) for camera, T in shots]
        self._appearance = Appearance([features for features, _ in self._views])

    def matches(self, features: Features) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Match the features of a picture with those of the views most similar to it.

        Returns:
            World points (M, 3), and the pixels (M, 2) of the picture. A feature may have several matches.
        """
        found = [matched(self._views[k], features) for k in self._appearance.alike(features, CANDIDATES)]
        return np.concatenate([xyz for xyz, _ in found]), np.concatenate([pixels for _, pixels in found])


def _rendered_features(
    renderer: MapRenderer, camera: PinholeCamera, T_camera_world: NDArray[np.float64]
) -> PlacedFeatures:
    """Detect features in a render of the map, and place them by its depth. Those without a sound depth are dropped."""
    view = renderer.view(camera, T_camera_world)
    features = detect_features(eight_bits(view.colour))
    z = _depth_at(view, camera, features.pixels)
    kept = z > 0
    xyz = camera.unproject(features.pixels[kept], z[kept]) - T_camera_world[:3, 3]
    return Features(features.pixels[kept], features.descriptors[kept], features.pixel), xyz @ T_camera_world[:3, :3]


def map_depth(
    renderer: MapRenderer, camera: PinholeCamera, T_camera_world: NDArray[np.float64], pixels: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the depth (N,) of the map at pixels (N, 2) of a view; 0 where there is no sound one."""
    return _depth_at(renderer.view(camera, T_camera_world), camera, pixels)


def _depth_at(view: RenderedView, camera: PinholeCamera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    depth = without_edges(view.expected_depth(MIN_OPACITY).astype(np.float32))
    column, row = np.minimum(np.floor(pixels).astype(int), [camera.width - 1, camera.height - 1]).T
    return depth[row, column].astype(np.float64)


def matched(view: PlacedFeatures, features: Features) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Match a render's features with those of a picture; returns world points (M, 3) and pixels (M, 2)."""
    pairs = match_anywhere(view[0], features)
    return view[1][pairs[:, 0]], features.pixels[pairs[:, 1]]


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
            xyz, pixels = matched(_rendered_features(self._renderer, found.camera, found.T_camera_world), features)
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
        xyz, pixels = matched(_rendered_features(self._renderer, camera, T), features)
        inlier = pixel_errors(camera, T, xyz, pixels) <= MAX_ERROR_THERE
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
