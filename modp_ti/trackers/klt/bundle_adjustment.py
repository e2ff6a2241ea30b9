"""Bundle adjustment of some keyframes of a map, others held, by pycolmap and Ceres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modp_ti.trackers.klt.landmark_map import LandmarkMap
from modp_ti.trackers.klt.lens import Lens

__all__ = ["adjust_bundle"]

LOSS_WIDTH = 1.0  # px


def adjust_bundle(
    landmarks: LandmarkMap,
    free: Sequence[int],
    held: Sequence[int] = (),
    steps: int = 10,
    focal: bool = False,
    distortion: bool = False,
) -> float:
    """Moves the keyframes `free` and the landmarks that they see, to the least robust reprojection error.

    held: keyframes that take part where they are; where there is none, the first two of `free` hold the world.
    steps: Levenberg-Marquardt steps at most. focal, distortion: whether these of the camera are refined too.
    Returns the mean cost of an observation [px^2 / 2], infinite where there is nothing to adjust.
    """
    import pycolmap

    views = sorted({*free, *held})
    of, slot, ids = landmarks.observations(views)
    free_mask = np.zeros(len(landmarks.keyframes), dtype=bool)
    free_mask[list(free)] = True
    wanted = np.zeros(len(landmarks.known), dtype=bool)
    wanted[ids[free_mask[of]]] = True
    used = wanted[ids] & (np.bincount(ids, minlength=len(wanted))[ids] >= 2)
    of, slot, ids = of[used], slot[used], ids[used]
    if len(ids) < 12:
        return float("inf")

    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(landmarks.lens.camera)
    config = pycolmap.BundleAdjustmentConfig()
    tracks: dict[int, list[tuple[int, int]]] = {}
    for k in views:
        mine = np.flatnonzero(of == k)
        keyframe = landmarks.keyframes[k]
        pixels = keyframe.pixels[slot[mine]]
        points = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
        image = pycolmap.Image(name=str(k), camera_id=1, image_id=k + 1, points2D=points)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(keyframe.T_camera_world[:3]))
        config.add_image(k + 1)
        if not free_mask[k]:
            config.set_constant_rig_from_world_pose(k + 1)
        for place, point in enumerate(ids[mine].tolist()):
            tracks.setdefault(point, []).append((k + 1, place))
    names = {}
    for point, seen in tracks.items():
        track = pycolmap.Track([pycolmap.TrackElement(*each) for each in seen])
        names[point] = model.add_point3D(landmarks.xyz[point], track)
    if not held:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    if not (focal or distortion):
        config.set_constant_cam_intrinsics(1)

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length, options.refine_extra_params = focal, distortion
    options.refine_principal_point = options.refine_sensor_from_rig = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_WIDTH
    solver = options.ceres.solver_options
    solver.max_num_iterations = steps
    solver.num_threads = 1  # sums of several threads depend on who comes first
    solver.function_tolerance = 1e-5
    summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    if not summary.is_solution_usable():
        return float("inf")

    for k in free:
        matrix = model.image(k + 1).cam_from_world().matrix()
        if np.isfinite(matrix).all():
            landmarks.keyframes[k].T_camera_world[:3] = matrix
    points = list(names)
    xyz = np.array([model.point3D(name).xyz for name in names.values()])
    finite = np.isfinite(xyz).all(axis=1)
    landmarks.xyz[np.array(points)[finite]] = xyz[finite]
    if focal or distortion:
        landmarks.use_lens(Lens(model.camera(1)))
    return float(summary.ceres_summary.final_cost / len(ids)) if hasattr(summary, "ceres_summary") else 0.0
