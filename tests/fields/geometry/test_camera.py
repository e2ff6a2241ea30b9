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


VALUES = {"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, "width": 4, "height": 4}
NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize("value", [0, -3.0, 4.5, NAN, INF, "4", None])
@pytest.mark.parametrize("name", ["width", "height"])
def test_impossible_sizes_are_refused_in_one_line(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]*must be positive and whole[^\n]*$"):
        PinholeCamera(**VALUES | {name: value})


@pytest.mark.parametrize(
    ("name", "value"), [("fx", 0.0), ("fy", -1.0), ("fx", NAN), ("fx", INF), ("cx", NAN), ("cy", INF)]
)
def test_impossible_intrinsics_are_refused_in_one_line(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]*must be[^\n]*$"):
        PinholeCamera(**VALUES | {name: value})


def test_numbers_of_any_type_become_plain_ones() -> None:
    camera = PinholeCamera(np.float64(60), np.float32(60), 32, np.int64(24), 64.0, np.int32(48))
    assert camera == PinholeCamera(60.0, 60.0, 32.0, 24.0, 64, 48)
    assert [type(value) for value in vars(camera).values()] == [float] * 4 + [int] * 2
