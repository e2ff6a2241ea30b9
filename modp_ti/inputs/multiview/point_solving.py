"""Triangulation of points from several views with known poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.multiview.reprojection import (
    Observations,
    point_errors,
    refine_points,
    solve_damped,
    sum_by_point,
)

__all__ = ["MAX_ERROR", "placed_anew", "solve_points", "surest_points"]

MAX_ERROR = 2.0  # largest reprojection error [px of the image used for detection]

# For tracked corners: points with less parallax [degrees] are used only where a frame would otherwise have fewer than
# ENOUGH points.
SURE_ANGLE = 4.0
ENOUGH = 50

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


def surest_points(
    poses: NDArray[np.float64], seen: Observations, xyz: NDArray[np.float64], solves: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], Observations]:
    """Select points with a parallax of at least SURE_ANGLE, and others where a solving frame has fewer than ENOUGH.

    With less parallax, errors of the given poses cause larger errors in depth.

    Args:
        poses: (F, 4, 4) T_camera_world.
        seen: Observations.
        xyz: (P, 3) positions.
        solves: (F,) False for held-out frames, whose rays and numbers of points do not count.

    Returns:
        The selected positions and their observations.
    """
    angle = _widest_angle(poses, seen.where(solves[seen.frame]), xyz)
    kept = angle >= SURE_ANGLE
    have = np.bincount(seen.frame[kept[seen.point]], minlength=len(poses))
    unsure = seen.where(~kept[seen.point] & solves[seen.frame])
    unsure = unsure.where(np.lexsort((unsure.point, -angle[unsure.point], unsure.frame)))
    first = np.searchsorted(unsure.frame, unsure.frame)
    kept[unsure.point[have[unsure.frame] + np.arange(len(unsure)) - first < ENOUGH]] = True
    seen = seen.where(kept[seen.point])
    return xyz[kept], Observations(seen.frame, (np.cumsum(kept) - 1)[seen.point], seen.rays, seen.sigma)


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
