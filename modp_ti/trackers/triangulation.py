"""Sparse points for posed images without any: features matched or followed from view to view, and triangulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modp_ti.sources import ImageSource
from modp_ti.trackers.feature_tracks import feature_tracks
from modp_ti.trackers.features import MAX_FEATURES, Features, detect_features, essential_matrix, match_features
from modp_ti.trackers.followed_features import follow_features, looks_like_video
from modp_ti.trackers.protocol import Progress
from modp_ti.trackers.replay import PosedImage, points_inside

__all__ = ["Observations", "neighbouring_views", "solve_points", "triangulated_frames"]

# Pairs of views that are matched: these many frames apart, and as many of the nearest others by pose. The
# growing gaps give parallax where the frames are those of a video.
GAPS = (1, 2, 3, 5)
NEIGHBOURS = 2
MAX_TURN = 45.0  # degrees between the optical axes of views that are matched

# Up to this many frames, features are matched between them: the wait is short, and frames may lie far apart.
FEW_FRAMES = 60
FEATURES_OF_MANY_FRAMES = 1000

# Followed corners: points of narrower angles [degrees] are used where a frame would have fewer than ENOUGH points.
SURE_ANGLE = 4.0
ENOUGH = 50

# In pixels of the image that the features were found in.
EPIPOLAR_BAND = 3.0
MAX_ERROR = 2.0

# Two views agree on any match along the epipolar line: it takes a third to confirm a point. Measured on a
# real sequence: one in ten points of two views was off by more than 6 % in depth, one in a hundred with more
# views.
MIN_VIEWS = 3
MIN_ANGLE = 1.5  # degrees between the rays that fix a point
SOLVER_STEPS = 6
ROUNDS = 3


@dataclass(frozen=True)
class Observations:
    """What is seen of which point where.

    frame, point: (M,) int64. rays: (M, 2) ideal coordinates. sigma: (M,) their uncertainty, one pixel of
    detection.
    """

    frame: NDArray[np.int64]
    point: NDArray[np.int64]
    rays: NDArray[np.float64]
    sigma: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.frame)

    def where(self, kept: NDArray[np.bool_]) -> Observations:
        return Observations(self.frame[kept], self.point[kept], self.rays[kept], self.sigma[kept])


def triangulated_frames(
    images: ImageSource,
    frames: Sequence[PosedImage],
    solves: NDArray[np.bool_],
    progress: Progress | None = None,
) -> list[PosedImage]:
    """The frames with points that keep their ids from view to view.

    solves: (F,) False for frames that must not take part in where a point lies (held-out ones): they are only
    told which of the points they see. The result depends on nothing but the images and poses.

    A few frames have their features matched with those of views around them. Of many, as of a video, corners are
    followed from frame to frame, which takes a tenth of the time; where the frames are too far apart for that, fewer
    features are matched.
    """
    poses = np.stack([frame.T_camera_world for frame in frames])
    if len(frames) > FEW_FRAMES and looks_like_video(images, frames, solves):
        seen = _followed(images, frames, solves, progress)
        xyz, seen = solve_points(poses, seen, solves)
        xyz, seen = _surest(poses, seen, xyz, solves)
    else:
        seen = _matched(images, frames, poses, progress)
        xyz, seen = solve_points(poses, seen, solves)
    result = []
    for i, frame in enumerate(frames):
        mine = seen.where(seen.frame == i)
        camera = frame.undistorter.camera
        pixels = mine.rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        points = points_inside(xyz[mine.point], pixels, mine.point, frame.undistorter, frame.T_camera_world)
        result.append(frame.with_points(points))
    return result


def _followed(
    images: ImageSource, frames: Sequence[PosedImage], solves: NDArray[np.bool_], progress: Progress | None
) -> Observations:
    """Corners followed along the frames."""
    found = follow_features(images, frames, solves, progress)
    rays = np.zeros((len(found.frame), 2))
    for i, frame in enumerate(frames):
        mine = found.frame == i
        rays[mine] = _ideal(frame, found.pixels[mine])
    focal = np.array([frame.undistorter.raw.focal for frame in frames])
    return Observations(found.frame, found.track, rays, found.pixel / focal[found.frame])


def _matched(
    images: ImageSource, frames: Sequence[PosedImage], poses: NDArray[np.float64], progress: Progress | None
) -> Observations:
    """Features matched between views that may see the same."""
    most = MAX_FEATURES if len(frames) <= FEW_FRAMES else FEATURES_OF_MANY_FRAMES
    features: list[Features] = []
    rays: list[NDArray[np.float64]] = []
    for i, frame in enumerate(frames):
        found = detect_features(images.read(frame.name), most)
        features.append(found)
        rays.append(_ideal(frame, found.pixels))
        if progress is not None:
            progress("finding features", i + 1, len(frames))

    pairs = neighbouring_views(poses)
    focal = np.array([frame.undistorter.raw.focal for frame in frames])
    sigma = np.array([each.pixel for each in features]) / focal
    matches = []
    for done, (a, b) in enumerate(pairs):
        descriptors = features[a].descriptors, features[b].descriptors
        essential = essential_matrix(poses[a], poses[b])
        found = match_features(*descriptors, rays[a], rays[b], essential, EPIPOLAR_BAND * sigma[b])
        matches.append((a, b, found))
        if progress is not None:
            progress("matching features", done + 1, len(pairs))

    view, number, track = feature_tracks([each.pixels for each in features], matches)
    seen_rays = np.array([rays[i][j] for i, j in zip(view, number, strict=True)]).reshape(-1, 2)
    return Observations(view, track, seen_rays, sigma[view])


def _ideal(frame: PosedImage, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ideal coordinates (N, 2) of pixels of the stored image."""
    camera = frame.undistorter.camera
    return (frame.undistorter.points(pixels) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)


def neighbouring_views(poses: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Pairs (a, b), a < b, of views that may see the same, for poses (F, 4, 4) world to camera."""
    count = len(poses)
    axes = poses[:, 2, :3]
    centres = -np.einsum("fji,fj->fi", poses[:, :3, :3], poses[:, :3, 3])
    alike = axes @ axes.T >= np.cos(np.radians(MAX_TURN))
    pairs = {(a, a + gap) for gap in GAPS for a in range(count - gap) if alike[a, a + gap]}
    for a in range(count):
        distance = np.linalg.norm(centres - centres[a], axis=1)
        distance[~alike[a]] = np.inf
        distance[a] = np.inf
        others = [int(b) for b in np.argsort(distance, kind="stable") if np.isfinite(distance[b])]
        fresh = [b for b in others if (min(a, b), max(a, b)) not in pairs and abs(a - b) > max(GAPS)]
        pairs.update((min(a, b), max(a, b)) for b in fresh[:NEIGHBOURS])
    return sorted(pairs)


# ---------------------------------------------------------------------------------------------------- solving


def solve_points(
    poses: NDArray[np.float64], seen: Observations, solves: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], Observations]:
    """Positions (P, 3) of the points under the poses (F, 4, 4), and the observations that agree with them.

    A point is kept where at least MIN_VIEWS frames with `solves` see it before them, within MAX_ERROR, under
    rays MIN_ANGLE apart; only these frames decide on its place. The others' observations are kept where they
    agree. Point numbers of the result are those of the rows of the positions.
    """
    used = seen.where(solves[seen.frame])
    used = used.where(np.isfinite(used.rays).all(axis=1))
    count = int(seen.point.max()) + 1 if len(seen) else 0
    xyz = np.zeros((count, 3))
    for _ in range(ROUNDS):
        used = used.where(np.bincount(used.point, minlength=count)[used.point] >= 2)
        if len(used) == 0:
            break
        xyz = _refined(poses, used, _nearest_to_rays(poses, used, count))
        error = _error(poses, used, xyz)
        # The worst observation of a point goes first: it may be what moved the point away from the others.
        worst = np.zeros(count)
        np.maximum.at(worst, used.point, error)
        good = (error <= MAX_ERROR) | (error < 0.5 * worst[used.point])
        if good.all():
            break
        used = used.where(good)
    used = used.where(_error(poses, used, xyz) <= MAX_ERROR)
    enough = np.bincount(used.point, minlength=count) >= min(MIN_VIEWS, int(solves.sum()))
    enough &= _widest_angle(poses, used, xyz) >= MIN_ANGLE
    seen = seen.where(enough[seen.point] & (_error(poses, seen, xyz) <= MAX_ERROR))
    numbers = np.cumsum(enough) - 1
    return xyz[enough], Observations(seen.frame, numbers[seen.point], seen.rays, seen.sigma)


def _surest(
    poses: NDArray[np.float64], seen: Observations, xyz: NDArray[np.float64], solves: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], Observations]:
    """The points with rays SURE_ANGLE apart at least, and those that some frame needs to have ENOUGH of them.

    Errors of the given poses turn into depth the more, the narrower the angle.
    """
    angle = _widest_angle(poses, seen.where(solves[seen.frame]), xyz)
    kept = angle >= SURE_ANGLE
    have = np.bincount(seen.frame[kept[seen.point]], minlength=len(poses))
    unsure = seen.where(~kept[seen.point])
    unsure = unsure.where(np.lexsort((unsure.point, -angle[unsure.point], unsure.frame)))
    first = np.searchsorted(unsure.frame, unsure.frame)
    kept[unsure.point[have[unsure.frame] + np.arange(len(unsure)) - first < ENOUGH]] = True
    seen = seen.where(kept[seen.point])
    return xyz[kept], Observations(seen.frame, (np.cumsum(kept) - 1)[seen.point], seen.rays, seen.sigma)


def _nearest_to_rays(poses: NDArray[np.float64], seen: Observations, count: int) -> NDArray[np.float64]:
    """Points (count, 3) with the least sum of squared distances to their rays."""
    rotation, translation = poses[seen.frame, :3, :3], poses[seen.frame, :3, 3]
    direction = np.einsum("mji,mj->mi", rotation, np.c_[seen.rays, np.ones(len(seen))])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    centre = -np.einsum("mji,mj->mi", rotation, translation)
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    left = _summed(seen.point, across, count)
    right = _summed(seen.point, np.einsum("mij,mj->mi", across, centre), count)
    return _solved(left, right, 1e-9)


def _refined(poses: NDArray[np.float64], seen: Observations, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gauss-Newton on the reprojection errors under a Cauchy loss."""
    rotation, translation = poses[seen.frame, :3, :3], poses[seen.frame, :3, 3]
    for _ in range(SOLVER_STEPS):
        p = np.einsum("mij,mj->mi", rotation, xyz[seen.point]) + translation
        z = np.where(np.abs(p[:, 2]) < 1e-9, 1e-9, p[:, 2])
        residual = (p[:, :2] / z[:, None] - seen.rays) / seen.sigma[:, None]
        jacobian = (rotation[:, :2] - (p[:, :2] / z[:, None])[:, :, None] * rotation[:, 2:]) / (z * seen.sigma)[
            :, None, None
        ]
        weight = 1.0 / (1.0 + (residual**2).sum(axis=1))
        weighted = weight[:, None, None] * jacobian
        left = _summed(seen.point, np.einsum("mki,mkj->mij", weighted, jacobian), len(xyz))
        right = _summed(seen.point, np.einsum("mki,mk->mi", weighted, residual), len(xyz))
        xyz = xyz - _solved(left, right, 1e-6)
    return xyz


def _summed(point: NDArray[np.int64], values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Sums (count, ...) of the values (M, ...) of each point."""
    columns = values.reshape(len(values), -1).T
    sums = [np.bincount(point, weights=column, minlength=count) for column in columns]
    return np.stack(sums, axis=1).reshape(count, *values.shape[1:])


def _solved(left: NDArray[np.float64], right: NDArray[np.float64], damping: float) -> NDArray[np.float64]:
    """Solutions (P, 3) of small symmetric systems; zero for a point that nothing is known about."""
    trace = np.trace(left, axis1=1, axis2=2)
    left = left + np.eye(3) * (damping * trace + (trace == 0))[:, None, None]
    return np.linalg.solve(left, right[..., None])[..., 0]


def _error(poses: NDArray[np.float64], seen: Observations, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Reprojection errors (M,) in pixels of detection; infinite behind the camera."""
    p = np.einsum("mij,mj->mi", poses[seen.frame, :3, :3], xyz[seen.point]) + poses[seen.frame, :3, 3]
    before = p[:, 2] > 1e-9
    z = np.where(before, p[:, 2], 1.0)
    error = np.linalg.norm(p[:, :2] / z[:, None] - seen.rays, axis=1) / seen.sigma
    return np.where(before & np.isfinite(error), error, np.inf)


def _widest_angle(poses: NDArray[np.float64], seen: Observations, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle [degrees] per point (P,) between two of its rays that are nearly the farthest apart.

    They are the ray farthest from the point's first one, and the one farthest from that.
    """
    count = len(xyz)
    centre = -np.einsum("mji,mj->mi", poses[seen.frame, :3, :3], poses[seen.frame, :3, 3])
    direction = xyz[seen.point] - centre
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    reference = np.zeros((count, 3))
    reference[seen.point[::-1]] = direction[::-1]
    cosine = np.ones(count)
    for _ in range(2):
        each = (direction * reference[seen.point]).sum(axis=1)
        cosine = np.ones(count)
        np.minimum.at(cosine, seen.point, each)
        farthest = np.flatnonzero(each == cosine[seen.point])
        reference[seen.point[farthest]] = direction[farthest]
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
