from __future__ import annotations

import numpy as np
import pytest

from fields.geometry.se3 import exp_se3
from fields.geometry.similarity import motion_around, moved_points, moved_pose, scale_of

BEFORE = exp_se3([0.3, -0.2, 0.4, 0.3, -0.5, 0.8])
AFTER = exp_se3([-1.0, 0.5, 0.2, 0.1, 0.9, -0.4])
XYZ = np.random.default_rng(0).normal(size=(20, 3))


def seen(T: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    return xyz @ T[:3, :3].T + T[:3, 3]


def test_what_a_camera_sees_goes_with_it_at_its_scale() -> None:
    S = motion_around(BEFORE, AFTER, 1.7)
    np.testing.assert_allclose(seen(AFTER, moved_points(S, XYZ)), 1.7 * seen(BEFORE, XYZ), atol=1e-12)
    assert scale_of(S) == pytest.approx(1.7)
    np.testing.assert_allclose(scale_of(np.stack([S, np.eye(4)])), [1.7, 1.0])


def test_another_camera_that_goes_with_the_world_sees_the_same() -> None:
    S = motion_around(BEFORE, AFTER, 0.6)
    np.testing.assert_allclose(moved_pose(S, BEFORE), AFTER, atol=1e-12)
    other = exp_se3([2.0, 0.1, -0.3, -0.2, 0.1, 0.7])
    T = moved_pose(S, other)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(seen(T, moved_points(S, XYZ)), 0.6 * seen(other, XYZ), atol=1e-12)


def test_a_pose_that_stays_moves_nothing_by_a_bit() -> None:
    S = motion_around(BEFORE, BEFORE.copy())
    np.testing.assert_array_equal(S, np.eye(4))
    np.testing.assert_array_equal(moved_pose(S, AFTER), AFTER)
    np.testing.assert_array_equal(moved_points(S, XYZ), XYZ)
