"""Points placed by the rays that see them, under poses that are known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.multiview.observations import Observations

__all__ = ["MAX_ERROR", "placed_anew", "point_errors", "solve_points", "surest_points"]

MAX_ERROR = 2.0  # pixels of the image that the features were found in

# Followed corners: points of narrower angles [degrees] are used where a frame would have fewer than ENOUGH points.
SURE_ANGLE = 4.0
ENOUGH = 50

# Two views agree on any match along the epipolar line: it takes a third to confirm a point. Measured on a
# real sequence: one in ten points of two views was off by more than 6 % in depth, one in a hundred with more
# views.
MIN_VIEWS = 3
MIN_ANGLE = 1.5  # degrees between the rays that fix a point
SOLVER_STEPS = 6
ROUNDS = 3


def solve_points(
    poses: NDArray[np.float64], seen: Observations, solves: NDArray[np.bool_], max_error: float = MAX_ERROR
) -> tuple[NDArray[np.float64], Observations]:
    """Positions (P, 3) of the points under the poses (F, 4, 4), and the observations that agree with them.

    A point is kept where at least MIN_VIEWS frames with `solves` see it before them, within max_error, under
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
        error = point_errors(poses, used, xyz)
        # The worst observation of a point goes first: it may be what moved the point away from the others.
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
    """The points (P, 3) moved to where frames with `solves` (F,) see them under the poses (F, 4, 4).

    A point stays where fewer than two of these see it, or where no place near its own has a smaller robust error.
    """
    used = seen.where(solves[seen.frame])
    used = used.where(np.bincount(used.point, minlength=len(xyz))[used.point] >= 2)
    if len(used) == 0:
        return xyz
    moved = _refined(poses, used, xyz)
    costs = []
    for places in (xyz, moved):
        error = point_errors(poses, used, places)
        costs.append(np.bincount(used.point, weights=np.log1p(error**2), minlength=len(xyz)))
    return np.where((costs[1] < costs[0])[:, None], moved, xyz)


def surest_points(
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


def point_errors(poses: NDArray[np.float64], seen: Observations, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
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
