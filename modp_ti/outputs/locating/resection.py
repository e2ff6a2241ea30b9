"""The pose, and where it is unknown the focal length, of a picture from matches with points (PnP)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera, pixel_jacobian
from modp_ti.inputs.multiview.reprojection import estimated, pixel_errors

CONFIDENCE = 0.9999
MOST_TRIALS = 5000
LEAST_SHARE = 0.03  # of inliers, for the number of trials
# A focal length outside this range, as shares of the longer side, is none of a camera.
PLAUSIBLE_FOCAL = (0.3, 4.0)


@dataclass(frozen=True)
class Resection:
    """The camera of a picture.

    Attributes:
        T_camera_world: Pose (4, 4).
        camera: The camera, with the estimated focal length if it was estimated.
        inlier: (N,) bool, the matches that agree.
    """

    T_camera_world: NDArray[np.float64]
    camera: PinholeCamera
    inlier: NDArray[np.bool_]


def resect(
    xyz: NDArray[np.float64],
    pixels: NDArray[np.float64],
    camera: PinholeCamera,
    max_error: float,
    seed: int,
    estimate_focal: bool = False,
) -> Resection | None:
    """Estimate the pose of a picture robustly, and refine it.

    Args:
        xyz: World points (N, 3).
        pixels: Their pixels (N, 2).
        camera: The camera.
        max_error: Largest reprojection error of an inlier [px].
        seed: Seed of RANSAC.
        estimate_focal: Whether to estimate the focal length too, from that of `camera`.

    Returns:
        The result; None if there is none, or if its focal length is none of a camera.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    if len(xyz) < 4:
        return None
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.estimate_focal_length = estimate_focal
    options.ransac.max_error = max_error
    options.ransac.random_seed = seed
    options.ransac.confidence = CONFIDENCE
    options.ransac.max_num_trials = MOST_TRIALS
    options.ransac.min_inlier_ratio = LEAST_SHARE
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = estimate_focal
    model, focal = ("SIMPLE_PINHOLE", [camera.focal]) if estimate_focal else ("PINHOLE", [camera.fx, camera.fy])
    found_by = pycolmap.Camera(
        model=model, width=camera.width, height=camera.height, params=[*focal, camera.cx, camera.cy]
    )
    found = estimated(pycolmap.estimate_and_refine_absolute_pose, pixels, xyz, found_by, options, refinement)
    if found is None:
        return None
    T = np.eye(4)
    T[:3] = found["cam_from_world"].matrix()
    if estimate_focal:  # the library writes it to its argument
        f = float(found_by.params[0])
        if not PLAUSIBLE_FOCAL[0] <= f / max(camera.width, camera.height) <= PLAUSIBLE_FOCAL[1]:
            return None
        camera = PinholeCamera(f, f, camera.cx, camera.cy, camera.width, camera.height)
    if not np.isfinite(T).all():
        return None
    return Resection(T, camera, pixel_errors(camera, T, xyz, pixels) <= max_error)


def pose_covariance(
    T_camera_world: NDArray[np.float64], xyz: NDArray[np.float64], pixels: NDArray[np.float64], camera: PinholeCamera
) -> NDArray[np.float64]:
    """Covariance of a pose from the reprojection errors of its inliers.

    Args:
        T_camera_world: Pose (4, 4).
        xyz: World points (N, 3) of the inliers, at least 4.
        pixels: Their pixels (N, 2).
        camera: The camera.

    Returns:
        Covariance (6, 6) of the tangent xi = (translation, rotation) of exp(xi) T_camera_world [scene units, rad].
    """
    p = xyz @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    residual = camera.project(p) - pixels
    J = pixel_jacobian(camera, p).reshape(-1, 6)
    variance = float((residual**2).sum()) / (residual.size - 6)
    return variance * np.linalg.inv(J.T @ J)
