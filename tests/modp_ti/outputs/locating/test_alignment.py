"""Poses from matches with points, and the similarity between two worlds, against true ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3, inverse_se3, log_se3, moved_points, moved_pose, scale_of
from modp_ti.outputs.locating.resection import pose_covariance, resect
from modp_ti.outputs.locating.world_alignment import PlacedFrame, image_motion, world_alignment
from tests.room import look_at
from tests.spread import disturbed

LENS = PinholeCamera(300.0, 300.0, 160.0, 120.0, 320, 240)

NOISE = 0.5


def matches(rng: np.random.Generator, count: int, wrong: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A pose T_camera_world, world points (N, 3), and their pixels (N, 2); the first `wrong` of them are anywhere."""
    T = exp_se3(rng.normal(size=6))
    pixels = rng.uniform([0, 0], [320, 240], (count, 2))
    p = LENS.unproject(pixels, rng.uniform(2, 6, count))
    pixels += rng.normal(0, NOISE, pixels.shape)
    pixels[:wrong] = rng.uniform([0, 0], [320, 240], (wrong, 2))
    T_world_camera = inverse_se3(T)
    return T, disturbed(p @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]), disturbed(pixels)


@pytest.mark.parametrize("focal", [300.0, 420.0])
def test_the_pose_and_an_unknown_focal_length_are_found_among_outliers(focal: float) -> None:
    guess = PinholeCamera(focal, focal, 160.0, 120.0, 320, 240)
    T, xyz, pixels = matches(np.random.default_rng(1), 300, 100 if focal != 300 else 200)
    found = resect(xyz, pixels, guess, 3.0, seed=0, estimate_focal=focal != 300)
    assert found is not None and found.camera.fx == found.camera.fy == pytest.approx(300.0, rel=0.01)
    assert found.inlier[200:].mean() > 0.95 and found.inlier[:100].mean() < 0.05
    assert np.abs(log_se3(found.T_camera_world @ inverse_se3(T))).max() < 0.05


def test_too_few_matches_give_no_pose() -> None:
    _, xyz, pixels = matches(np.random.default_rng(2), 3, 0)
    assert resect(xyz, pixels, LENS, 3.0, seed=0) is None


def test_the_covariance_is_that_of_the_errors() -> None:
    """Squared errors in units of the covariance have the mean 6 of a chi-squared distribution."""
    rng = np.random.default_rng(3)
    squares = []
    for _ in range(200):
        T, xyz, pixels = matches(rng, 60, 0)
        found = resect(xyz, pixels, LENS, 5.0, seed=0)
        assert found is not None
        error = log_se3(T @ inverse_se3(found.T_camera_world))
        squares.append(error @ np.linalg.solve(pose_covariance(found.T_camera_world, xyz, pixels, LENS), error))
    assert 4.5 < np.mean(squares) < 8.5


CAMERA = PinholeCamera(240.0, 240.0, 160.0, 120.0, 320, 240)

SCALE = 3.2

S_MAP_TRACKER = np.diag([SCALE, SCALE, SCALE, 1.0]) @ exp_se3([1.0, -4.0, 0.3, 1.2, -0.8, 2.0])

FRAMES = 8


def placed(rng: np.random.Generator, spread: float, bias: float = 0.0, noise: float = 0.0) -> list[PlacedFrame]:
    """Cameras some 3 m before the scene and up to `spread` [m] apart.

    bias: Added to the logarithms of the map's depths. noise: Standard deviation of the located poses, of the tangent.
    """
    frames = []
    for index in range(FRAMES):
        eye = np.array([0.0, -3.0, 1.0]) + rng.uniform(-0.5, 0.5, 3) * spread
        T = look_at(eye, rng.uniform(-0.3, 0.3, 3))
        depth = rng.uniform(2.0, 4.0, 60)
        local = CAMERA.unproject(rng.uniform(0, 1, (60, 2)) * [320, 240], depth)
        xyz = (local - T[:3, 3]) @ T[:3, :3]
        S = np.linalg.inv(S_MAP_TRACKER)
        T_located = exp_se3(noise * rng.normal(size=6)) @ T
        seen = depth * np.exp(bias + 0.02 * rng.normal(size=60))
        frames.append(
            PlacedFrame(index, CAMERA, T_located, moved_pose(S, T), np.arange(60), seen, moved_points(S, xyz))
        )
    return frames


def apart(S: NDArray[np.float64]) -> float:
    """How far S moves a point of the scene [m]."""
    point = moved_points(np.linalg.inv(S_MAP_TRACKER), np.zeros((1, 3)))
    return float(np.linalg.norm(moved_points(S, point)))


def test_exact_poses_give_the_exact_similarity() -> None:
    found = world_alignment(placed(np.random.default_rng(0), spread=1.0, bias=-0.03))
    assert found is not None and (found.placed, found.agreeing) == (FRAMES, FRAMES)
    # The depths, which are 3 % too small, hold the scale back by little.
    assert found.scale == pytest.approx(SCALE, rel=2e-3)
    assert found.scale == pytest.approx(float(scale_of(found.S_map_tracker)))
    assert apart(found.S_map_tracker) < 0.01
    assert found.residual < 0.3


def test_cameras_at_one_place_take_the_scale_from_the_depths() -> None:
    found = world_alignment(placed(np.random.default_rng(1), spread=1e-4, noise=1e-4))
    assert found is not None
    assert found.scale == pytest.approx(SCALE, rel=0.02)


def test_noise_of_the_located_poses_averages_out() -> None:
    """The seven numbers of a similarity take in a seventh of the variance of eight noisy poses."""
    frames = placed(np.random.default_rng(2), spread=1.0, noise=2e-3)
    found = world_alignment(frames)
    assert found is not None
    true = [moved_pose(S_MAP_TRACKER, frame.T_camera_tracker) for frame in frames]
    joint = [moved_pose(found.S_map_tracker, frame.T_camera_tracker) for frame in frames]
    alone = [frame.T_camera_map for frame in frames]
    errors = [[image_motion(CAMERA, 3.0, *pair) for pair in zip(of, true, strict=True)] for of in (joint, alone)]
    assert np.mean(errors[0]) < 0.7 * np.mean(errors[1])


def test_wrong_frames_do_not_count() -> None:
    frames = placed(np.random.default_rng(3), spread=1.0)
    beside = exp_se3([1.0, 0, 0, 0, 0.3, 0])
    frames[:3] = [replace(frame, T_camera_map=beside @ frame.T_camera_map) for frame in frames[:3]]
    found = world_alignment(frames)
    assert found is not None and (found.placed, found.agreeing) == (FRAMES, FRAMES - 3)
    assert apart(found.S_map_tracker) < 0.01


def test_too_few_frames_that_agree_give_nothing() -> None:
    frames = placed(np.random.default_rng(4), spread=1.0)
    assert world_alignment([]) is None
    assert world_alignment(frames[:2]) is None
    shifted = [replace(f, T_camera_map=exp_se3([0.3 * f.index, 0, 0, 0, 0, 0]) @ f.T_camera_map) for f in frames]
    assert world_alignment(shifted) is None
    assert world_alignment([replace(f, ids=f.ids[:5], depth=f.depth[:5], xyz=f.xyz[:5]) for f in frames]) is None


def test_image_motion_is_in_pixels() -> None:
    """A turn by an angle moves the image by about the focal length times the angle, whatever the depth."""
    T = exp_se3([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    turned = exp_se3([0, 0, 0, 0.0, 0.01, 0]) @ T
    for depth in (0.5, 5.0):
        assert image_motion(CAMERA, depth, T, turned) == pytest.approx(240 * 0.01, rel=0.2)
    moved = exp_se3([0.01, 0, 0, 0, 0, 0]) @ T
    assert image_motion(CAMERA, 2.0, T, moved) == pytest.approx(240 * 0.01 / 2.0, rel=0.3)
