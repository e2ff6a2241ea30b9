"""Bundle adjustment of given poses to pixel accuracy, in the world frame of the given poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3, orthonormalised
from modp_ti.inputs.multiview.bundle_adjustment import adjusted_bundle
from modp_ti.inputs.multiview.point_solving import solve_points
from modp_ti.inputs.multiview.reprojection import Observations, ray_errors, refine_pose

__all__ = ["adjusted_poses"]

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
        _carry_along(poses, before, moved)
        for i in np.flatnonzero(~moved):
            mine = agreeing.where(agreeing.frame == i)
            poses[i] = _resected(poses[i], mine, xyz, width)
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


def _carry_along(poses: NDArray[np.float64], before: NDArray[np.float64], moved: NDArray[np.bool_]) -> None:
    """Move each frame that was not adjusted rigidly with the adjusted frame that is nearest in time, in place."""
    there = np.flatnonzero(moved)
    if len(there) == 0:
        return
    for i in np.flatnonzero(~moved):
        k = there[np.argmin(np.abs(there - i))]
        poses[i] = before[i] @ inverse_se3(before[k]) @ poses[k]


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
