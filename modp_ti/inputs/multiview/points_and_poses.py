"""Points from several views with given poses, and bundle adjustment of these poses in their own world."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3, orthonormalised
from modp_ti.inputs.multiview.bundle_adjustment import adjusted_bundle
from modp_ti.inputs.multiview.reprojection import (
    Observations,
    point_errors,
    ray_errors,
    refine_points,
    refine_pose,
    solve_damped,
    sum_by_point,
)

MAX_ERROR = 2.0  # largest reprojection error [px of the image used for detection]

# Two views agree on any match along the epipolar line, so a third one must confirm a point. On a real sequence, one in
# ten points of two views was off by more than 6 % in depth, and one in a hundred with more views.
MIN_VIEWS = 3
MIN_ANGLE = 1.5  # smallest parallax of a point in degrees
ROUNDS = 3


def solve_points(
    poses: NDArray[np.float64], seen: Observations, solves: NDArray[np.bool_], max_error: float = MAX_ERROR
) -> tuple[NDArray[np.float64], Observations]:
    """Triangulate points robustly.

    A point is kept if at least MIN_VIEWS frames with `solves` observe it in front of them within `max_error`, with a
    parallax of at least MIN_ANGLE. Only these frames determine its position. Observations of the other frames are kept
    if they agree.

    Args:
        poses: (F, 4, 4) T_camera_world.
        seen: Observations.
        solves: (F,) False for held-out frames.
        max_error: Largest reprojection error [px of the image used for detection].

    Returns:
        Positions (P, 3), and the observations that agree with them, whose points index the rows of the positions.
    """
    used = seen.where(solves[seen.frame])
    used = used.where(np.isfinite(used.rays[:, 0]) & np.isfinite(used.rays[:, 1]))
    count = int(seen.point.max()) + 1 if len(seen) else 0
    xyz = np.zeros((count, 3))
    for _ in range(ROUNDS):
        used = used.where(np.bincount(used.point, minlength=count)[used.point] >= 2)
        if len(used) == 0:
            break
        xyz = refine_points(poses, used, _nearest_to_rays(poses, used, count))
        error = point_errors(poses, used, xyz)
        # Remove a point's worst observations first: they may have pulled it away from the good ones.
        worst = np.zeros(count)
        np.maximum.at(worst, used.point, error)
        good = (error <= max_error) | (error < 0.5 * worst[used.point])
        if good.all():
            break
        used = used.where(good)
    used = used.where(point_errors(poses, used, xyz) <= max_error)
    enough = np.bincount(used.point, minlength=count) >= min(MIN_VIEWS, int(solves.sum()))
    enough &= _widest_angle(poses, used, xyz) >= MIN_ANGLE
    seen = seen.where(enough[seen.point] & (point_errors(poses, seen, xyz) <= max_error))
    numbers = np.cumsum(enough) - 1
    return xyz[enough], Observations(seen.frame, numbers[seen.point], seen.rays, seen.sigma)


def placed_anew(
    poses: NDArray[np.float64], seen: Observations, xyz: NDArray[np.float64], solves: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Refine points after their poses have changed.

    A point is unchanged if fewer than two frames with `solves` observe it, or if its robust error does not decrease.

    Args:
        poses: (F, 4, 4) T_camera_world.
        seen: Observations.
        xyz: (P, 3) initial positions.
        solves: (F,) False for held-out frames, which are not used.

    Returns:
        Positions (P, 3).
    """
    used = seen.where(solves[seen.frame])
    used = used.where(np.bincount(used.point, minlength=len(xyz))[used.point] >= 2)
    if len(used) == 0:
        return xyz
    moved = refine_points(poses, used, xyz)
    costs = []
    for places in (xyz, moved):
        error = point_errors(poses, used, places)
        costs.append(np.bincount(used.point, weights=np.log1p(error**2), minlength=len(xyz)))
    return np.where((costs[1] < costs[0])[:, None], moved, xyz)


def _nearest_to_rays(poses: NDArray[np.float64], seen: Observations, count: int) -> NDArray[np.float64]:
    """Points (count, 3) that minimise the sum of squared distances to their rays."""
    rotation, translation = poses[seen.frame, :3, :3], poses[seen.frame, :3, 3]
    direction = np.einsum("mji,mj->mi", rotation, np.c_[seen.rays, np.ones(len(seen))])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    centre = -np.einsum("mji,mj->mi", rotation, translation)
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    left = sum_by_point(seen.point, across, count)
    right = sum_by_point(seen.point, np.einsum("mij,mj->mi", across, centre), count)
    return solve_damped(left, right, 1e-9)


def _widest_angle(poses: NDArray[np.float64], seen: Observations, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Approximate largest angle [degrees] (P,) between two rays of each point.

    It is the angle between the ray farthest from the point's first ray, and the ray farthest from that one.
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


STEPS = 30
FEWEST = 8  # fewest points for a pose, and shared points that connect two frames


def adjusted_poses(
    poses: NDArray[np.float64], seen: Observations, solves: NDArray[np.bool_], gates: Sequence[float]
) -> NDArray[np.float64]:
    """Bundle adjust poses together with the points that they observe.

    Frames with `solves` are adjusted jointly with the points. Each of the others moves rigidly with the nearest
    adjusted frame in time, and is then localised by the points that it observes. Sets of frames without shared points
    are adjusted separately; each set is aligned with its given poses by a similarity transform.

    Args:
        poses: (F, 4, 4) given T_camera_world.
        seen: Observations.
        solves: (F,) False for held-out frames.
        gates: Largest reprojection error [px of the image used for detection] of the observations used in each round,
            in decreasing order. It starts wide, because the observations that contradict a wrong pose are needed to
            correct it.

    Returns:
        Adjusted T_camera_world (F, 4, 4), in the world frame of the given poses.
    """
    given = poses
    for gate in gates:
        xyz, agreeing = solve_points(poses, seen, solves, gate)
        before, poses = poses, poses.copy()
        moved = np.zeros(len(poses), dtype=bool)
        # The loss widens with the gate; in the last rounds its scale is the usual 1 px.
        width = max(1.0, gate / 4)
        for stretch in _stretches(agreeing, solves):
            mine = agreeing.where(np.isin(agreeing.frame, stretch))
            found = _adjusted_stretch(before, given, mine, xyz, width)
            if found is None:
                continue
            for i, T in found[0].items():
                poses[i], moved[i] = T, True
            numbers, places = found[1:]
            xyz[numbers] = places
        there = np.flatnonzero(moved)
        for i in np.flatnonzero(~moved):
            if len(there):
                k = there[np.argmin(np.abs(there - i))]
                poses[i] = before[i] @ inverse_se3(before[k]) @ poses[k]
            poses[i] = _resected(poses[i], agreeing.where(agreeing.frame == i), xyz, width)
    return np.stack([orthonormalised(T) for T in poses])


def _stretches(seen: Observations, solves: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Sets of solving frames that are connected by shared points, with at least three frames each."""
    used = seen.where(solves[seen.frame])
    used = used.where(np.lexsort((used.frame, used.point)))
    follows = used.point[1:] == used.point[:-1]
    links = np.stack([used.frame[:-1][follows], used.frame[1:][follows]], axis=1)
    links, count = np.unique(links, axis=0, return_counts=True)
    root = np.arange(len(solves))
    for a, b in links[count >= FEWEST].tolist():
        one, other = sorted((root[a], root[b]))
        root[root == other] = one
    sets = [np.flatnonzero(solves & (root == each)) for each in np.unique(root[solves])]
    return [each for each in sets if len(each) >= 3]


def _adjusted_stretch(
    poses: NDArray[np.float64],
    given: NDArray[np.float64],
    seen: Observations,
    xyz: NDArray[np.float64],
    loss_width: float,
) -> tuple[dict[int, NDArray[np.float64]], NDArray[np.int64], NDArray[np.float64]] | None:
    """Bundle adjust one set of frames and align it with the given poses.

    Returns the poses by frame, the indices (P,) of the points, and their positions (P, 3); None if it fails.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    # A camera whose pixels are those of detection and whose principal point is 0.
    focal = 1.0 / float(np.median(seen.sigma))
    side = int(2 * focal)
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", width=side, height=side, params=[focal, 0.0, 0.0])
    views = np.unique(seen.frame).tolist()
    starts, pixels = {i: poses[i] for i in views}, focal * seen.rays
    bundle = adjusted_bundle(camera, starts, seen.frame, seen.point, pixels, xyz, set(views), STEPS, loss_width)
    if bundle is None or len(bundle.poses) < len(views):
        return None
    adjusted = np.stack([bundle.poses[i] for i in views])
    s, R, t = _alignment(adjusted, given[views])
    # x_given = s R x_adjusted + t. The camera frames scale with the world.
    adjusted[:, :3, :3] = adjusted[:, :3, :3] @ R.T
    adjusted[:, :3, 3] = s * adjusted[:, :3, 3] - adjusted[:, :3, :3] @ t
    return dict(zip(views, adjusted, strict=True)), bundle.points, s * bundle.xyz @ R.T + t


def _alignment(
    source: NDArray[np.float64], target: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Similarity transform between the worlds of two sets of poses (N, 4, 4): scale, rotation (3, 3), translation (3,).

    It uses camera centres and orientations, so that the rotation is also determined for straight or stationary paths.
    """
    a, b = (np.stack([inverse_se3(T)[:3, 3] for T in poses]) for poses in (source, target))
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    a, b = a - mean_a, b - mean_b
    directions = np.einsum("nji,njk->ik", target[:, :3, :3], source[:, :3, :3]) / len(source)
    places = b.T @ a / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300)
    U, _, Vt = np.linalg.svd(directions + places)
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    extent = float((a * a).sum())
    s = float((b * (a @ R.T)).sum()) / extent if extent > 0 else 1.0
    if not s > 0:  # the given camera centres are noise
        s = 1.0
    return s, R, mean_b - s * R @ mean_a


def _resected(
    T: NDArray[np.float64], seen: Observations, xyz: NDArray[np.float64], width: float
) -> NDArray[np.float64]:
    """Refine a pose (4, 4) by the points that it observes. Returns `T` if this increases the median error."""
    seen = seen.where(np.isfinite(seen.rays[:, 0]) & np.isfinite(seen.rays[:, 1]))
    if len(seen) < FEWEST:
        return T
    sigma = float(np.median(seen.sigma))
    places = xyz[seen.point]
    refined = T
    for each in (4.0 * width, width):
        refined = refine_pose(refined, places, seen.rays, each * sigma)
    better = np.median(ray_errors(refined, places, seen.rays)) <= np.median(ray_errors(T, places, seen.rays))
    return refined if better else T
