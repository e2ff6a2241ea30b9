"""Where sky is looked for, and Gaussians that no step of the camera moves in its image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.densify.depth.estimate import DepthEstimate, unknown_depth
from pipelines.densify.sky import sky_pixels, sky_seeds

CAMERA = PinholeCamera(200.0, 200.0, 120.0, 80.0, 240, 160)
POSE = exp_se3([0.3, -0.2, 0.4, 0.1, -0.2, 0.3])
HORIZON = 70
NOTHING = np.zeros((160, 240), dtype=np.float32)


@pytest.fixture
def view() -> Keyframe:
    """A bright gradient over noise; in the noise a plain window, in the sky a tracked point, perhaps of a bird."""
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 1, (160, 240, 3)).astype(np.float32)
    image[:HORIZON] = np.linspace(0.9, 0.6, HORIZON, dtype=np.float32)[:, None, None]
    image[100:140, 60:120] = 0.4
    pixels = np.concatenate([rng.uniform([5, 80], [235, 155], (50, 2)), [[120.0, 30.0]]])
    camera_points = CAMERA.unproject(pixels, np.full(51, 4.0))
    points = SparsePoints((camera_points - POSE[:3, 3]) @ POSE[:3, :3], pixels, np.arange(51))
    return KeyframeStore().append(TrackedFrame(0, 0.0, "v", image, CAMERA, POSE, points))


def test_sky_is_smooth_reaches_the_upper_edge_has_no_point_and_is_not_mapped(view: Keyframe) -> None:
    pixels = sky_pixels(view, NOTHING)
    assert (pixels[:, 1] < HORIZON).all()
    assert 0.8 * HORIZON < pixels[:, 1].max() and np.ptp(pixels[:, 0]) > 200
    assert np.abs(pixels - [120.0, 30.0]).max(axis=1).min() > 4
    assert 100 < len(pixels) < 700
    left = NOTHING.copy()
    left[:, :120] = 0.9
    assert (sky_pixels(view, left)[:, 0] > 120).all()


def test_sky_stays_where_it_is_in_the_image_while_the_camera_moves(view: Keyframe) -> None:
    pixels = sky_pixels(view, NOTHING)
    seeds = sky_seeds(view, pixels, unknown_depth(len(pixels)))
    near = exp_se3([0.05 * view.median_depth, 0.05 * view.median_depth, 0, 0, 0, 0]) @ POSE
    for T, most in ((POSE, 1e-9), (near, 0.3)):
        seen = CAMERA.project(seeds.xyz @ T[:3, :3].T + T[:3, 3])
        assert np.abs(seen - pixels).max() < most  # [px]; a step that moves the rest by ten
    np.testing.assert_allclose(seeds.colour, 0.75, atol=0.16)


def test_where_the_depth_is_known_the_sky_is_a_wall(view: Keyframe) -> None:
    pixels = sky_pixels(view, NOTHING)
    known = DepthEstimate(np.full(len(pixels), 5.0), np.full(len(pixels), 0.2))
    seeds = sky_seeds(view, pixels, known)
    np.testing.assert_allclose((seeds.xyz @ POSE[:3, :3].T + POSE[:3, 3])[:, 2], 5.0)


def test_neither_size_nor_scale_of_a_view_changes_the_sky(view: Keyframe) -> None:
    pixels = sky_pixels(view, NOTHING)
    seeds = sky_seeds(view, pixels, unknown_depth(len(pixels)))
    apart = np.median(np.diff(np.unique(pixels[:, 0])))
    np.testing.assert_allclose(seeds.size / view.median_depth * CAMERA.focal, 50 * apart)
    larger = replace(view, median_depth=3 * view.median_depth)
    np.testing.assert_allclose(sky_seeds(larger, pixels, unknown_depth(len(pixels))).size, 3 * seeds.size)
