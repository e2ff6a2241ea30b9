"""Lens models agree with pycolmap's and OpenCV's; their inverse gives the point back or NaN."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest

from modp_ti.inputs.sources.distortion import Distortion, colmap_intrinsics

MODELS = {
    "SIMPLE_PINHOLE": [500, 318, 242],
    "PINHOLE": [500, 510, 318, 242],
    "SIMPLE_RADIAL": [500, 318, 242, -0.11],
    "RADIAL": [500, 318, 242, 0.08, -0.05],
    "OPENCV": [500, 510, 318, 242, 0.0578, -0.0805, -0.00098, 0.00156],
    "FULL_OPENCV": [500, 510, 318, 242, 0.26, -0.95, -0.0054, 0.0026, 1.16, 0.1, -0.05, 0.02],
    "OPENCV_FISHEYE": [300, 310, 318, 242, -0.02, 0.01, -0.004, 0.0006],
    "SIMPLE_RADIAL_FISHEYE": [300, 318, 242, -0.03],
    "RADIAL_FISHEYE": [300, 318, 242, -0.03, 0.004],
    "SIMPLE_FISHEYE": [300, 318, 242],
    "FISHEYE": [300, 310, 318, 242],
    "FOV": [300, 310, 318, 242, 0.9],
    "THIN_PRISM_FISHEYE": [300, 310, 318, 242, -0.02, 0.01, 0.0007, -0.0004, -0.004, 0.0006, 0.001, -0.002],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        *(300, 310, 318, 242, 0.02, -0.03, 0.01, -0.004, 0.001, -0.0003),
        *(0.0008, -0.0005, -0.0007, 0.0002, -0.0004, 0.0001),
    ],
}


def grid(reach_x: float, reach_y: float, count: int = 15) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-reach_x, reach_x, count), np.linspace(-reach_y, reach_y, count))
    return np.stack([x.ravel(), y.ravel()], axis=1)


@pytest.mark.parametrize("model", MODELS)
def test_forward_agrees_with_pycolmap(model):
    camera = pycolmap.Camera(model=model, width=640, height=480, params=MODELS[model])
    fx, fy, cx, cy, distortion = colmap_intrinsics(model, MODELS[model])
    ideal = grid(0.62, 0.47)
    expected = camera.img_from_cam(np.c_[ideal, np.ones(len(ideal))])
    np.testing.assert_allclose(distortion.distort(ideal) * (fx, fy) + (cx, cy), expected, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_inverse_agrees_with_pycolmap(model):
    camera = pycolmap.Camera(model=model, width=640, height=480, params=MODELS[model])
    fx, fy, cx, cy, distortion = colmap_intrinsics(model, MODELS[model])
    pixels = np.add(grid(270, 200), (320, 240))
    ideal = distortion.undistort((pixels - (cx, cy)) / (fx, fy), limit=3.0)
    np.testing.assert_allclose(ideal, camera.cam_from_img(pixels), atol=1e-7)


def test_camera_models_that_are_no_pinhole_are_not_taken_for_one():
    for model in ("SIMPLE_DIVISION", "EUCM", "EQUIRECTANGULAR"):
        assert colmap_intrinsics(model, [1.0] * 16) is None


def test_agrees_with_opencv():
    k1, k2, p1, p2, k3 = 0.2624, -0.9531, -0.0054, 0.0026, 1.1633
    ideal = grid(0.5, 0.4)
    expected, _ = cv2.projectPoints(
        np.c_[ideal, np.ones(len(ideal))], np.zeros(3), np.zeros(3), np.eye(3), np.array([k1, k2, p1, p2, k3])
    )
    ours = Distortion((k1, k2, k3), tangential=(p1, p2)).distort(ideal)
    np.testing.assert_allclose(ours, expected[:, 0], atol=1e-12)


def test_beyond_the_fold_there_is_no_inverse():
    distortion = Distortion((-0.3,))  # r (1 - 0.3 r^2) grows up to r = 1 / sqrt(0.9) and reaches 0.7027
    fold = 1 / np.sqrt(0.9)
    assert distortion.valid_radius(3.0) == pytest.approx(fold, abs=2e-3)
    assert distortion.valid_radius(0.5) == 0.5
    assert np.isnan(distortion.undistort(np.array([[0.71, 0.0], [2.0, 2.0]]), limit=3.0)).all()
    ideal = np.array([[0.0, 0.0], [0.6, 0.6], [0.0, -1.0]])
    np.testing.assert_allclose(distortion.undistort(distortion.distort(ideal), limit=3.0), ideal, atol=1e-8)
