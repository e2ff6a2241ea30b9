"""What all replayed trackers share: poses are checked, points are those that the delivered image shows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fields.camera import PinholeCamera
from modp_ti.errors import InputError
from modp_ti.sources import Undistorter
from modp_ti.trackers.replay import checked_pose, points_inside


def test_nearly_rigid_pose_becomes_the_nearest_rigid_one():
    R = Rotation.from_euler("xyz", [0.3, -0.7, 2.0]).as_matrix()
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = 1.001 * R, [1, 2, 3]
    pose = checked_pose(T, "frame")
    np.testing.assert_allclose(pose[:3, :3], R, atol=1e-12)
    assert pose[:3, 3].tolist() == [1, 2, 3]
    with pytest.raises(InputError, match=r"^frame: the pose is no rigid motion"):
        checked_pose(np.diag([1.1, 1.1, 1.1, 1.0]), "frame")


def test_only_known_points_before_the_camera_and_inside_the_image_are_delivered():
    undistorter = Undistorter(PinholeCamera(100, 100, 50, 40, 100, 80))
    xyz = np.array([[0, 0, 2.0], [0, 0, -2.0], [0, 0, 3.0], [0, 0, 3.0], [np.nan, 0, 1.0]])
    pixels = np.array([[50, 40], [50, 40], [100.0, 40], [np.nan, 1], [5, 5]])
    points = points_inside(xyz, pixels, np.arange(10, 15), undistorter, np.eye(4))
    assert points.ids.tolist() == [10]
    assert points.xyz.tolist() == [[0, 0, 2]] and points.pixels.tolist() == [[50, 40]]
