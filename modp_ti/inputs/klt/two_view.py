"""Two-view geometry: relative motion and structure from matched features."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.klt.landmark_map import triangulated
from modp_ti.inputs.klt.lens import Lens
from modp_ti.inputs.multiview.estimators import estimated

__all__ = ["TwoViews", "two_views"]

MAX_ERROR = 1.5  # px, RANSAC threshold
FEWEST = 40  # points with parallax


@dataclass(frozen=True)
class TwoViews:
    """Relative motion of two views with triangulated points.

    Attributes:
        T_b_a: (4, 4), with a translation of length 1.
        xyz: (N, 3) points in the frame of a.
        good: (N,) mask of the reliable points.
        planar: Whether the motion comes from a homography.
    """

    T_b_a: NDArray[np.float64]
    xyz: NDArray[np.float64]
    good: NDArray[np.bool_]
    planar: bool


def two_views(
    lens: Lens, pixels_a: NDArray[np.float64], pixels_b: NDArray[np.float64], min_angle: float, seed: int
) -> TwoViews | None:
    """Estimate the motion between two views from an essential matrix, or a homography for a planar scene.

    Args:
        lens: The camera of both views.
        pixels_a: (N, 2) features in the first view.
        pixels_b: (N, 2) the same features in the second view.
        min_angle: Smallest median parallax in degrees. Pure rotation has no parallax.
        seed: Seed of RANSAC.

    Returns:
        Motion and points; None if the motion cannot be estimated reliably.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    if len(pixels_a) < FEWEST:
        return None
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.detect_watermark = False
    options.ransac.max_error = MAX_ERROR
    options.ransac.random_seed = seed
    options.ransac.max_num_trials = 2000
    pairs = np.repeat(np.arange(len(pixels_a), dtype=np.uint32)[:, None], 2, axis=1)
    found = estimated(
        pycolmap.estimate_calibrated_two_view_geometry,
        lens.camera,
        np.ascontiguousarray(pixels_a),
        lens.camera,
        np.ascontiguousarray(pixels_b),
        pairs,
        options,
    )
    kinds = pycolmap.TwoViewGeometryConfiguration
    if found is None or found.config not in (kinds.CALIBRATED, kinds.PLANAR) or found.cam2_from_cam1 is None:
        return None
    T = np.eye(4)
    T[:3] = found.cam2_from_cam1.matrix()
    length = float(np.linalg.norm(T[:3, 3]))
    if not np.isfinite(T).all() or length < 1e-9:
        return None
    T[:3, 3] /= length
    xyz, good = triangulated(
        np.eye(4), T, lens.rays(pixels_a), lens.rays(pixels_b), 2 * MAX_ERROR / lens.focal, min_angle=0.5
    )
    if good.sum() < max(FEWEST, 0.5 * len(pixels_a)):
        return None
    if np.degrees(np.median(_angles(T, xyz[good]))) < min_angle:
        return None
    return TwoViews(T, xyz, good, found.config == kinds.PLANAR)


def _angles(T_b_a: NDArray[np.float64], xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Parallax (N,) of points (N, 3), radians."""
    centre = -T_b_a[:3, :3].T @ T_b_a[:3, 3]
    a = xyz / np.linalg.norm(xyz, axis=1, keepdims=True)
    b = xyz - centre
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    return np.arccos(np.clip((a * b).sum(axis=1), -1.0, 1.0))
