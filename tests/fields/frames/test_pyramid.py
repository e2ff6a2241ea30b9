from __future__ import annotations

import numpy as np
import pytest

from fields.frames.pyramid import MIN_SIDE, build_pyramid
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.keyframes import KeyframeStore

CAMERA = PinholeCamera(800.0, 760.0, 520.0, 240.0, 1024, 512)


def image() -> np.ndarray:
    rgba = np.random.default_rng(0).integers(0, 256, (512, 1024, 4), dtype=np.uint8)
    rgba[..., 3] = 255
    return rgba


def test_a_pixel_is_the_mean_of_those_that_it_covers() -> None:
    rgba = image()
    levels = build_pyramid(rgba, CAMERA, 3)
    mean = rgba.reshape(256, 2, 512, 2, 4).astype(float).mean(axis=(1, 3))
    assert [level.rgba.shape for level in levels] == [(512, 1024, 4), (256, 512, 4), (128, 256, 4)]
    np.testing.assert_allclose(levels[1].rgba, mean, atol=0.51)
    assert levels[0].rgba is rgba


def test_a_point_is_seen_at_the_same_place_of_every_level() -> None:
    point = np.array([[0.3, -0.2, 2.0]])
    full, half, quarter = (level.camera.project(point) for level in build_pyramid(image(), CAMERA, 3))
    np.testing.assert_allclose(half, full / 2)
    np.testing.assert_allclose(quarter, full / 4)


def test_a_pixel_is_valid_where_all_that_it_covers_are() -> None:
    rgba = image()
    rgba[10, 21] = 0
    half = build_pyramid(rgba, CAMERA, 2)[1].rgba
    assert (half[5, 10] == 0).all()
    assert np.count_nonzero(half[..., 3] == 0) == 1


def test_odd_sides_keep_the_field_of_view() -> None:
    camera = PinholeCamera(400.0, 400.0, 150.5, 130.5, 301, 261)
    half = build_pyramid(np.full((261, 301, 4), 255, dtype=np.uint8), camera, 2)[1].camera
    assert (half.width, half.height) == (150, 130)
    assert half.width / half.fx == pytest.approx(301 / 400.0)
    assert half.height / half.fy == pytest.approx(261 / 400.0)


def test_no_level_is_too_small_for_the_loss() -> None:
    levels = build_pyramid(image(), CAMERA, 8)
    assert min(levels[-1].camera.width, levels[-1].camera.height) >= MIN_SIDE
    assert min(levels[-1].camera.width, levels[-1].camera.height) < 2 * MIN_SIDE


def test_a_keyframe_at_a_level_is_the_same_view_of_fewer_pixels() -> None:
    points = SparsePoints(np.array([[0.3, -0.2, 2.0]]), CAMERA.project(np.array([[0.3, -0.2, 2.0]])), np.array([7]))
    view = np.random.default_rng(1).uniform(size=(512, 1024, 3)).astype(np.float32)
    keyframe = KeyframeStore(levels=3).append(TrackedFrame(0, 0.0, "a", view, CAMERA, np.eye(4), points))
    half = keyframe.at_level(1)
    np.testing.assert_allclose(half.points.pixels, half.camera.project(points.xyz))
    assert half.rgba.shape == (256, 512, 4)
    assert half.pyramid[0].rgba is half.rgba
    assert half.view_scale == pytest.approx(2 * keyframe.view_scale)
    assert keyframe.at_level(9).rgba.shape == (128, 256, 4)  # the coarsest there is


def test_a_keyframe_keeps_the_levels_that_are_large_enough() -> None:
    view = np.full((512, 1024, 3), 0.5, dtype=np.float32)
    frame = TrackedFrame(0, 0.0, "a", view, CAMERA, np.eye(4))
    for levels, min_side, kept in ((4, 1, 4), (4, 128, 3), (4, 129, 2), (2, 128, 2), (4, 4000, 1)):
        pyramid = KeyframeStore(levels, min_side).append(frame).pyramid
        assert [image.camera.height for image in pyramid] == [512, 256, 128, 64][:kept]
