"""Bundle adjustment of given poses, with the points that were triangulated with them, by pycolmap and Ceres."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.se3 import inverse_se3, orthonormalised
from modp_ti.trackers.klt.pose import refine_pose
from modp_ti.trackers.observations import Observations

__all__ = ["adjusted_poses"]

STEPS = 50
LOSS_WIDTH = 1.0  # px of detection
# Frames that see fewer points stay as they are to their neighbours' world.
FEWEST = 8


def adjusted_poses(
    poses: NDArray[np.float64], seen: Observations, xyz: NDArray[np.float64], solves: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Poses (F, 4, 4) world to camera of least robust reprojection error, in the world of the given ones.

    Frames with `solves` (F,) are moved together with the points; the others afterwards, each by the points that it
    sees. The result is turned, moved and scaled as a whole to lie on the given poses.
    """
    import pycolmap

    frames = [i for i in np.flatnonzero(solves) if np.count_nonzero(seen.frame == i) >= FEWEST]
    if len(frames) < 2:
        return poses
    # Ideal coordinates in pixels of detection.
    focal = 1.0 / float(np.median(seen.sigma))
    model = pycolmap.Reconstruction()
    side = int(2 * focal)
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", width=side, height=side, params=[focal, 0.0, 0.0])
    model.add_camera_with_trivial_rig(camera)
    config = pycolmap.BundleAdjustmentConfig()
    config.set_constant_cam_intrinsics(1)
    tracks: dict[int, list[tuple[int, int]]] = {}
    for i in frames:
        mine = np.flatnonzero(seen.frame == i)
        points = pycolmap.Point2DList([pycolmap.Point2D(focal * ray) for ray in seen.rays[mine]])
        image = pycolmap.Image(name=str(i), camera_id=1, image_id=int(i) + 1, points2D=points)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(poses[i, :3]))
        config.add_image(int(i) + 1)
        for place, point in enumerate(seen.point[mine].tolist()):
            tracks.setdefault(point, []).append((int(i) + 1, place))
    names = {
        point: model.add_point3D(xyz[point], pycolmap.Track([pycolmap.TrackElement(*each) for each in track]))
        for point, track in tracks.items()
    }
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_principal_point = False
    options.refine_extra_params = options.refine_sensor_from_rig = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_WIDTH
    options.ceres.solver_options.max_num_iterations = STEPS
    options.ceres.solver_options.num_threads = 1  # sums of several threads depend on who comes first
    if not pycolmap.create_default_bundle_adjuster(options, config, model).solve().is_solution_usable():
        return poses

    adjusted = poses.copy()
    for i in frames:
        adjusted[i, :3] = model.image(int(i) + 1).cam_from_world().matrix()
    if not np.isfinite(adjusted).all():
        return poses
    s, R, t = _alignment(adjusted[frames], poses[frames])
    # x_given = s R x_adjusted + t, so that T_given ~ diag(s, 1) T_adjusted (the inverse of that).
    adjusted[frames, :3, :3] = adjusted[frames, :3, :3] @ R.T
    adjusted[frames, :3, 3] = s * adjusted[frames, :3, 3] - adjusted[frames, :3, :3] @ t
    moved = xyz.copy()
    for point, name in names.items():
        moved[point] = s * R @ model.point3D(name).xyz + t
    for i in np.flatnonzero(~solves):
        mine = seen.frame == i
        if np.count_nonzero(mine) >= FEWEST:
            adjusted[i] = refine_pose(poses[i], moved[seen.point[mine]], seen.rays[mine], 1.0 / focal)
    return np.stack([orthonormalised(T) for T in adjusted])


def _alignment(
    source: NDArray[np.float64], target: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Scale, rotation (3, 3), translation (3,) from the world of the poses (N, 4, 4) `source` to that of `target`.

    By the cameras' directions too, so that a straight way or a turn on the spot has one as well.
    """
    U, _, Vt = np.linalg.svd(np.einsum("nji,njk->ik", target[:, :3, :3], source[:, :3, :3]))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    a, b = (np.array([inverse_se3(T)[:3, 3] for T in poses]) for poses in (source, target))
    spread_a, spread_b = (float(np.linalg.norm(c - c.mean(axis=0))) for c in (a, b))
    s = spread_b / spread_a if min(spread_a, spread_b) > 0 else 1.0
    return s, R, b.mean(axis=0) - s * R @ a.mean(axis=0)
