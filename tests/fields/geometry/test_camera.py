from __future__ import annotations

import cv2
import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(500.0, 480.0, 310.0, 250.0, 640, 480)


def test_projection_is_that_of_opencv_with_centres_half_a_pixel_on() -> None:
    points = np.random.default_rng(0).uniform([-2, -2, 1], [2, 2, 6], (50, 3))
    K = CAMERA.matrix()
    K[:2, 2] -= 0.5
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, None)[0][:, 0] + 0.5
    np.testing.assert_allclose(CAMERA.project(points), expected, rtol=1e-9)


def test_unprojection_undoes_projection() -> None:
    points = np.random.default_rng(1).uniform([-2, -2, 1], [2, 2, 6], (50, 3))
    np.testing.assert_allclose(CAMERA.unproject(CAMERA.project(points), points[:, 2]), points, rtol=1e-12)


def test_a_resized_camera_sees_the_same_place_at_the_same_share_of_the_image() -> None:
    points = np.random.default_rng(2).uniform([-1, -1, 1], [1, 1, 6], (20, 3))
    small = CAMERA.resized(161, 119)
    np.testing.assert_allclose(small.project(points) / [161, 119], CAMERA.project(points) / [640, 480], rtol=1e-12)


def test_the_image_ends_before_its_width() -> None:
    pixels = np.array([[0, 0], [639.999, 479.999], [640, 10], [10, 480], [-0.001, 5]])
    assert CAMERA.contains(pixels).tolist() == [True, True, False, False, False]


@pytest.mark.parametrize("wrong", [{"width": 0}, {"fx": 0.0}, {"fy": -1.0}, {"fx": float("nan")}])
def test_impossible_cameras_are_refused(wrong: dict[str, float]) -> None:
    values = {"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, "width": 4, "height": 4} | wrong
    with pytest.raises(ValueError, match="must be positive"):
        PinholeCamera(**values)
