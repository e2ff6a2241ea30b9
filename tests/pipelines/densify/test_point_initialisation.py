from __future__ import annotations

import numpy as np
import pytest

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.gaussians import SH_C0, GaussianField
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.densify.point_initialisation import PointCloud, initialise, spacing, union_of_points

CAMERA = PinholeCamera(20.0, 20.0, 8.0, 6.0, 16, 12)


def view(index: int, ids: list[int], pixels: list[tuple[float, float]], xyz: np.ndarray, red: float) -> Keyframe:
    """A view of one colour; its pixel in row 0, column 0 is masked."""
    image = np.tile(np.array([red, 0.2, 0.8], dtype=np.float32), (12, 16, 1))
    mask = np.ones((12, 16), dtype=bool)
    mask[0, 0] = False
    points = SparsePoints(xyz, np.array(pixels), np.array(ids))
    return KeyframeStore().view(TrackedFrame(index, 0.0, "v", image, CAMERA, np.eye(4), points, mask))


def test_every_tracked_point_counts_once_as_the_last_view_that_shows_it_has_it() -> None:
    first = view(0, [7, 3, 5, 9], [(4, 4), (5, 5), (6, 6), (0.5, 0.5)], np.arange(12.0).reshape(4, 3), 0.2)
    second = view(1, [5, 3, 8], [(0.5, 0.5), (9, 9), (16.5, 3)], 100 + np.arange(9.0).reshape(3, 3), 0.6)
    cloud = union_of_points([first, second])
    # 5 is masked in the second view, 9 in its only one; 8 lies outside.
    np.testing.assert_array_equal(cloud.xyz, [[103, 104, 105], [6, 7, 8], [0, 1, 2]])
    np.testing.assert_allclose(cloud.colour, [[0.6, 0.2, 0.8], [0.2, 0.2, 0.8], [0.2, 0.2, 0.8]])


def test_no_view_has_no_points() -> None:
    assert len(union_of_points([])) == 0


def test_spacing_is_the_mean_distance_of_the_three_nearest() -> None:
    # Far from the origin, as worlds of trackers are.
    xyz = np.random.default_rng(3).normal(size=(700, 3)) * [1, 5, 0.1] + 300
    distances = np.sort(np.linalg.norm(xyz[:, None] - xyz[None], axis=2), axis=1)
    np.testing.assert_allclose(spacing(xyz), distances[:, 1:4].mean(axis=1), rtol=1e-4)


def test_too_few_points_are_refused() -> None:
    with pytest.raises(ValueError, match="3 points have no 3 neighbours each"):
        spacing(np.eye(3))


def test_gaussians_begin_round_faint_and_as_wide_as_their_spacing() -> None:
    rng = np.random.default_rng(1)
    cloud = PointCloud(rng.normal(size=(30, 3)), rng.random((30, 3)))
    cloud.xyz[:4] = 9.0  # coincide
    gaussians = GaussianField(2, max_gaussians=1024)
    initialise(gaussians, cloud, opacity=0.1, smallest=1e-3)
    state = gaussians.to_numpy()
    np.testing.assert_allclose(state["position"], cloud.xyz, rtol=1e-6)
    width = np.maximum(spacing(cloud.xyz), 1e-3)
    np.testing.assert_allclose(np.exp(state["log_scale"]), np.repeat(width[:, None], 3, axis=1), rtol=1e-5)
    np.testing.assert_allclose(np.exp(state["log_scale"][:4]), 1e-3, rtol=1e-5)
    np.testing.assert_allclose(gaussians.opacities(), 0.1, rtol=1e-5)
    np.testing.assert_allclose(0.5 + SH_C0 * state["sh"][:, 0], cloud.colour, atol=1e-6)
    assert (state["sh"][:, 1:] == 0).all()
    np.testing.assert_array_equal(state["quaternion"], np.tile([1, 0, 0, 0], (30, 1)))


def test_a_smaller_pool_takes_points_from_everywhere() -> None:
    gaussians = GaussianField(0, max_gaussians=1024)
    xyz = np.stack([np.arange(4096.0), np.zeros(4096), np.zeros(4096)], axis=1)
    initialise(gaussians, PointCloud(xyz, np.zeros((4096, 3))), opacity=0.1, smallest=1e-3)
    np.testing.assert_allclose(gaussians.to_numpy()["position"][:, 0], np.arange(0, 4096, 4))
