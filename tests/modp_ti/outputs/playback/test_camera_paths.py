"""Paths through a map: rigid poses that go where they say."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3
from modp_ti.outputs.playback.camera_paths import looking_at, orbit, smoothed

UP = np.array([0.0, 0.0, 1.0])


def ring(angles: NDArray, inwards: bool, radius: float = 2.0, centre: tuple = (1.0, -2.0, 0.5)) -> NDArray:
    """Upright cameras on a circle, 0.4 above its centre, that look across it or away from it."""
    poses = []
    for angle in angles:
        way = np.array([np.cos(angle), np.sin(angle), 0.0])
        eye = np.array(centre) + radius * way + [0, 0, 0.4]
        poses.append(looking_at(eye, np.array(centre) if inwards else eye + way, UP))
    return np.stack(poses)


def centres(poses: NDArray) -> NDArray:
    return -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])


def assert_rigid(poses: NDArray) -> None:
    R = poses[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-9)
    assert (np.linalg.det(R) > 0).all()


def test_looking_at_puts_the_target_in_the_middle_and_up_upwards() -> None:
    T = looking_at(np.array([1.0, 2.0, 3.0]), np.array([-1.0, 0.5, 2.0]), UP)
    p = T[:3, :3] @ [-1.0, 0.5, 2.0] + T[:3, 3]
    np.testing.assert_allclose(p[:2], 0, atol=1e-12)
    assert p[2] > 0
    assert (T[:3, :3] @ UP)[1] < 0  # y of the camera points down


def test_a_ring_around_an_object_is_closed_into_a_whole_turn_that_looks_at_it() -> None:
    poses = orbit(ring(np.linspace(0, 2 * np.pi, 30, endpoint=False), inwards=True), depth=2.0, count=40)
    assert_rigid(poses)
    away = centres(poses) - [1.0, -2.0, 0.5]
    np.testing.assert_allclose(np.linalg.norm(away[:, :2], axis=1), 2.0, rtol=1e-2)
    angles = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
    np.testing.assert_allclose(np.abs(np.diff(angles)), 2 * np.pi / 40, rtol=1e-2)
    assert (np.einsum("ij,ij->i", poses[:, 2, :3], -away) > 0).all()


def test_within_a_room_it_looks_outwards_as_the_cameras_do() -> None:
    keyframes = ring(np.linspace(0, 2 * np.pi, 30, endpoint=False), inwards=False, radius=0.5)
    poses = orbit(keyframes, depth=3.0, count=24)
    away = centres(poses) - np.array([1.0, -2.0, 0.9])
    assert (np.einsum("ij,ij->i", poses[:, 2, :3], away) > 0).all()


def test_what_was_seen_from_one_side_is_not_gone_around() -> None:
    taken = np.radians(np.linspace(150, 240, 30))  # across the cut of the angle at 180 degrees
    poses = orbit(ring(taken, inwards=True), depth=2.0, count=60)
    away = centres(poses) - [1.0, -2.0, 0.5]
    angles = np.degrees(np.arctan2(away[:, 1], away[:, 0])) % 360
    assert 150 < angles.min() < 170 and 220 < angles.max() < 240
    assert np.abs(np.diff(angles, append=angles[:1])).max() < 6  # to and fro, without a jump at its end


def test_one_keyframe_is_enough_for_an_orbit() -> None:
    poses = orbit(ring(np.zeros(1), inwards=True), depth=2.0, count=8)
    assert_rigid(poses)
    assert np.isfinite(poses).all()


def test_smoothing_keeps_a_steady_motion_and_calms_a_trembling_one() -> None:
    step = exp_se3([0.02, 0.0, 0.01, 0.0, 0.01, 0.0])
    steady = [np.eye(4)]
    for _ in range(59):
        steady.append(step @ steady[-1])
    rng = np.random.default_rng(1)
    trembling = np.stack([exp_se3(rng.normal(0, 0.01, 6)) @ T for T in steady])
    steady = np.stack(steady)
    assert_rigid(smoothed(trembling, 100, 4.0))
    np.testing.assert_allclose(smoothed(steady, 60, 3.0)[15:45], steady[15:45], atol=3e-3)

    def unrest(poses: NDArray) -> float:
        return float(np.abs(np.diff(centres(poses), n=2, axis=0))[10:-10].max())

    assert unrest(smoothed(trembling, 60, 4.0)) < 0.1 * unrest(trembling)


@pytest.mark.parametrize("deviation", [0.0, 1e-4])
def test_without_smoothing_the_recorded_poses_come_back(deviation: float) -> None:
    poses = ring(np.linspace(0, 1, 7), inwards=True)
    np.testing.assert_allclose(smoothed(poses, 7, deviation), poses, atol=1e-9)
