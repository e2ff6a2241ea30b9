"""Sparse points for posed images that come without: features are matched or tracked, and triangulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import far_centre, shifted_poses
from modp_ti.inputs.multiview.features import (
    MAX_FEATURES,
    Features,
    detect_features,
    essential_matrix,
    feature_tracks,
    match_features,
)
from modp_ti.inputs.multiview.followed_features import EPIPOLAR_BAND, follow_features
from modp_ti.inputs.multiview.points_and_poses import adjusted_poses, solve_points
from modp_ti.inputs.multiview.reprojection import Observations, point_errors
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import PosedImage, points_inside
from modp_ti.inputs.sources import ImageSource

# Views are matched with those GAPS frames apart, and with the NEIGHBOURS nearest others by pose. The growing gaps give
# parallax in videos.
GAPS = (1, 2, 3, 5)
NEIGHBOURS = 2
MAX_TURN = 45.0  # largest angle in degrees between the optical axes of matched views

# Up to this many frames, SIFT features are always matched: it takes little time, and the frames may be far apart.
FEW_FRAMES = 60
FEATURES_OF_MANY_FRAMES = 1000
# Corners are followed where each is found in so many frames in the mean: where half are found again in the next one.
FOLLOWED = 2.0

# For poses that are adjusted: largest distance [px] of features from the epipolar line, and largest reprojection error
# in each round, before and after revisited places have been matched.
WIDE_BAND = 12.0
FIRST_GATES = (16.0, 8.0)
GATES = (16.0, 8.0, 4.0, 2.0, 2.0)
# Revisited places: a view is selected when at most STILL_SEEN of the last selected view's corners are still tracked.
# Each is matched with the REVISITED nearest ones by pose.
STILL_SEEN = 0.7
REVISITED = 6


def triangulated_frames(
    images: ImageSource,
    frames: Sequence[PosedImage],
    solves: NDArray[np.bool_],
    progress: Progress | None = None,
) -> list[PosedImage]:
    """Triangulate points for frames with known poses.

    With few frames, SIFT features are matched between neighbouring views. With many, as in a video, corners are tracked
    from frame to frame, which takes a tenth of the time. If the frames are too far apart for tracking, fewer SIFT
    features per view are matched.

    Args:
        images: Source of the images.
        frames: The F frames with their poses.
        solves: (F,) False for held-out frames. They do not influence the positions of points, and are only given the
            points that they observe.
        progress: Called during the computation.

    Returns:
        The frames with points, whose ids are the same in all views. The result depends only on the images and poses.
    """
    sequence = _Sequence(images, frames, solves, progress)
    return sequence.with_points(sequence.poses, sequence.seen(EPIPOLAR_BAND))


def adjusted_frames(
    images: ImageSource,
    frames: Sequence[PosedImage],
    solves: NDArray[np.bool_],
    progress: Progress | None = None,
) -> tuple[list[PosedImage], str]:
    """Triangulate points as `triangulated_frames` does, and bundle adjust the poses with them.

    Args:
        images: Source of the images.
        frames: The F frames with their poses.
        solves: (F,) False for held-out frames. They do not influence other poses, and are localised by the points that
            they observe.
        progress: Called during the computation.

    Returns:
        The frames with adjusted poses and points, and a note on the change of the reprojection error.
    """
    sequence = _Sequence(images, frames, solves, progress)
    seen = sequence.seen(WIDE_BAND)
    given = poses = sequence.poses
    if sequence.follows:
        poses = adjusted_poses(poses, seen, solves, FIRST_GATES)
        views = _views_apart(seen, solves)
        again = sequence.matched(poses, views, FEATURES_OF_MANY_FRAMES, REVISITED, WIDE_BAND)
        poses = adjusted_poses(poses, seen.beside(again), solves, GATES)
    else:
        poses = adjusted_poses(poses, seen, solves, GATES)
    (before, count), (after, _) = (_median_error(each, seen, solves) for each in (given, poses))
    note = (
        f"the poses are bundle adjusted with {count} points that the images show: median reprojection error "
        f"{before:.2f} px before, {after:.2f} px after (tracker.adjust)"
        if count
        else "the images show too little in common to adjust the poses: they stay as given (tracker.adjust)"
    )
    return sequence.with_points(poses, seen), note


def _median_error(poses: NDArray[np.float64], seen: Observations, solves: NDArray[np.bool_]) -> tuple[float, int]:
    """Median reprojection error [px] of points triangulated with these poses and the widest gate, and their number."""
    xyz, agreeing = solve_points(poses, seen, solves, GATES[0])
    errors = point_errors(poses, agreeing, xyz)
    return (float(np.median(errors)) if len(errors) else float("nan")), len(xyz)


class _Sequence:
    """Frames whose features are observed.

    `poses` are the given ones, of a world that begins near the cameras. `follows`, once they are observed: corners are
    tracked from frame to frame, instead of matching SIFT features.
    """

    def __init__(
        self, images: ImageSource, frames: Sequence[PosedImage], solves: NDArray[np.bool_], progress: Progress | None
    ) -> None:
        self._images, self._frames, self._solves, self._progress = images, frames, solves, progress
        self._focal = np.array([frame.undistorter.raw.focal for frame in frames])
        poses = np.stack([frame.T_camera_world for frame in frames])
        self._origin = far_centre(poses)
        self.poses = shifted_poses(poses, -self._origin)
        self.follows = False

    def seen(self, band: float) -> Observations:
        """Observations of the frames, from tracked corners or matched features."""
        count = len(self._frames)
        if count > FEW_FRAMES:
            seen = follow_features(self._images, self._frames, self._solves, self._progress, band)
            used = seen.point[self._solves[seen.frame]]
            self.follows = len(used) > 0 and len(used) >= FOLLOWED * len(np.unique(used))
            if self.follows:
                return seen
        most = MAX_FEATURES if count <= FEW_FRAMES else FEATURES_OF_MANY_FRAMES
        return self.matched(self.poses, np.arange(count), most, NEIGHBOURS, band)

    def matched(
        self, poses: NDArray[np.float64], views: NDArray[np.int64], most: int, neighbours: int, band: float
    ) -> Observations:
        """Observations of SIFT features, `most` per view, matched between neighbouring frames of `views` (V,)."""
        features: list[Features] = []
        rays: list[NDArray[np.float64]] = []
        for i in views.tolist():
            found = detect_features(self._images.read(self._frames[i].name), most)
            features.append(found)
            rays.append(self._frames[i].undistorter.rays(found.pixels))
            self._tell("finding features", len(features), len(views))

        poses = poses[views]
        pairs = neighbouring_views(poses, neighbours)
        sigma = np.array([each.pixel for each in features]) / self._focal[views]
        matches = []
        for a, b in pairs:
            descriptors = features[a].descriptors, features[b].descriptors
            essential = essential_matrix(poses[a], poses[b])
            found = match_features(*descriptors, rays[a], rays[b], essential, band * sigma[b])
            matches.append((a, b, found))
            self._tell("matching features", len(matches), len(pairs))

        view, number, track = feature_tracks([each.pixels for each in features], matches, ~self._solves[views])
        seen_rays = np.array([rays[i][j] for i, j in zip(view, number, strict=True)]).reshape(-1, 2)
        return Observations(views[view], track, seen_rays, sigma[view])

    def with_points(self, poses: NDArray[np.float64], seen: Observations) -> list[PosedImage]:
        """Triangulate the observations with these poses, and give each frame its pose and points."""
        xyz, seen = solve_points(poses, seen, self._solves)
        result = []
        for i, (frame, T) in enumerate(zip(self._frames, poses, strict=True)):
            mine = seen.where(seen.frame == i)
            camera = frame.undistorter.camera
            pixels = mine.rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)
            points = points_inside(xyz[mine.point], pixels, mine.point, frame.undistorter, T)
            points = replace(points, xyz=points.xyz + self._origin)
            result.append(replace(frame, T_camera_world=shifted_poses(T, self._origin), points=points))
        return result

    def _tell(self, what: str, done: int, total: int) -> None:
        if self._progress is not None:
            self._progress(what, done, total)


def neighbouring_views(poses: NDArray[np.float64], neighbours: int = NEIGHBOURS) -> list[tuple[int, int]]:
    """Choose pairs of views that may see the same points.

    Args:
        poses: (F, 4, 4) T_camera_world.
        neighbours: Number of nearest views by pose that each view is paired with, in addition to those near in order.

    Returns:
        Pairs (a, b) with a < b.
    """
    count = len(poses)
    axes = poses[:, 2, :3]
    centres = -np.einsum("fji,fj->fi", poses[:, :3, :3], poses[:, :3, 3])
    alike = axes @ axes.T >= np.cos(np.radians(MAX_TURN))
    pairs = {(a, a + gap) for gap in GAPS for a in range(count - gap) if alike[a, a + gap]}
    for a in range(count):
        distance = np.linalg.norm(centres - centres[a], axis=1)
        others = [int(b) for b in np.argsort(distance, kind="stable") if alike[a, b] and np.isfinite(distance[b])]
        fresh = [b for b in others if (min(a, b), max(a, b)) not in pairs and abs(a - b) > max(GAPS)]
        pairs.update((min(a, b), max(a, b)) for b in fresh[:neighbours])
    return sorted(pairs)


def _views_apart(seen: Observations, solves: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Solving frames (V,): the first, and each that sees at most STILL_SEEN of the last selected one's points."""
    of = [seen.point[seen.frame == i] for i in range(len(solves))]
    views: list[int] = []
    for i in np.flatnonzero(solves).tolist():
        if not views or np.isin(of[views[-1]], of[i]).sum() <= STILL_SEEN * len(of[views[-1]]):
            views.append(i)
    return np.array(views, dtype=np.int64)
