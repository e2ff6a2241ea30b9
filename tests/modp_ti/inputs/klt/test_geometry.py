"""Poses, two views, patches and bundles of scenes that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3, inverse_se3
from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.klt.frame import corners, flow
from modp_ti.inputs.klt.initialisation import two_views
from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap, triangulated
from modp_ti.inputs.klt.localisation import align_landmarks, reference_views
from modp_ti.inputs.multiview.reprojection import pose_from_points, ray_errors, refine_pose

CAMERA = PinholeCamera(500.0, 500.0, 320.0, 240.0, 640, 480)


def cloud(rng: np.random.Generator, count: int = 200) -> NDArray[np.float64]:
    return np.c_[rng.uniform(-2, 2, (count, 2)), rng.uniform(4, 8, count)]


def seen(T: NDArray[np.float64], xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rays (N, 2)."""
    p = xyz @ T[:3, :3].T + T[:3, 3]
    return p[:, :2] / p[:, 2:]


def pixels(T: NDArray[np.float64], xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    return 500.0 * seen(T, xyz) + (320.0, 240.0)


def test_a_pose_is_found_and_refined_past_wrong_matches():
    rng = np.random.default_rng(0)
    xyz, T = cloud(rng), exp_se3([0.4, -0.2, 0.3, 0.1, 0.3, -0.2])
    rays = seen(T, xyz)
    rays[::2] += rng.uniform(0.05, 0.3, (100, 2))
    found, again = (pose_from_points(xyz, rays, 2 / 500, seed=1) for _ in range(2))
    assert found is not None and again is not None
    np.testing.assert_allclose(found[0], T, atol=1e-6)
    np.testing.assert_array_equal(found[1], np.arange(200) % 2 == 1)
    np.testing.assert_array_equal(found[0], again[0])
    assert pose_from_points(xyz[:3], rays[:3], 0.01, seed=0) is None

    rays = seen(T, xyz)
    rays[:30] += 0.1
    start = exp_se3([0.05, -0.04, 0.03, 0.01, 0.02, -0.01]) @ T
    np.testing.assert_allclose(refine_pose(start, xyz, rays, 1 / 500, steps=30), T, atol=2e-3)
    assert np.isinf(ray_errors(np.eye(4), np.array([[0.0, 0.0, -2.0]]), np.zeros((1, 2)))[0])


@pytest.mark.parametrize("planar", [False, True])
def test_two_views_tell_the_motion_of_a_cloud_and_of_a_plane(planar):
    rng = np.random.default_rng(2)
    xyz = cloud(rng)
    if planar:
        xyz[:, 2] = 5 + 0.4 * xyz[:, 0] + 0.1 * xyz[:, 1]
    T = exp_se3([0.6, 0.1, 0.1, 0.02, -0.08, 0.01])
    noise = 0.2 * rng.standard_normal((2, 200, 2))
    found = two_views(Lens.pinhole(CAMERA), pixels(np.eye(4), xyz) + noise[0], pixels(T, xyz) + noise[1], 2.0, seed=0)
    assert found is not None and found.planar == planar
    direction = T[:3, 3] / np.linalg.norm(T[:3, 3])
    assert found.T_b_a[:3, 3] @ direction > np.cos(np.radians(3))
    np.testing.assert_allclose(found.T_b_a[:3, :3], T[:3, :3], atol=0.01)
    scale = np.linalg.norm(T[:3, 3])
    assert np.median(np.linalg.norm(scale * found.xyz - xyz, axis=1)[found.good]) < 0.35  # 0.016 to 0.161, 12 draws


def test_a_turn_tells_no_motion():
    rng = np.random.default_rng(3)
    xyz = cloud(rng)
    a, b = pixels(np.eye(4), xyz), pixels(exp_se3([0, 0, 0, 0.02, 0.1, 0.05]), xyz)
    assert two_views(Lens.pinhole(CAMERA), a, b + 0.2 * rng.standard_normal(b.shape), 1.0, seed=0) is None


def test_triangulation_asks_for_parallax():
    rng = np.random.default_rng(4)
    xyz = cloud(rng, 50)
    for baseline, reliable in ((0.5, True), (0.01, False)):
        T = exp_se3([-baseline, 0, 0, 0, 0, 0])
        found, good = triangulated(np.eye(4), T, seen(np.eye(4), xyz), seen(T, xyz), 2 / 500)
        assert (good == reliable).all()
        if reliable:
            np.testing.assert_allclose(found, xyz, atol=1e-9)


def small_map(rng: np.random.Generator, noise: float, lens: Lens | None = None) -> tuple[LandmarkMap, list, NDArray]:
    """Six keyframes of 150 landmarks, their poses and places disturbed by `noise`; with the true ones."""
    lens = lens or Lens.pinhole(CAMERA)
    xyz = cloud(rng, 150)
    truth = [exp_se3([-0.25 * i, 0.05 * i * i, 0.02 * i, 0, 0.02 * i, 0.01 * i]) for i in range(6)]
    landmarks = LandmarkMap(lens)
    ids = landmarks.new_ids(150)
    for i, T in enumerate(truth):
        at = pixels(T, xyz)
        disturbed = exp_se3(noise * rng.standard_normal(6) * (i > 1)) @ T
        landmarks.add_keyframe(Keyframe(i, disturbed, np.zeros((480, 640), np.uint8), ids, at, lens.rays(at)))
    landmarks.xyz[ids], landmarks.known[ids] = xyz + noise * rng.standard_normal(xyz.shape), True
    return landmarks, truth, xyz


def test_bundle_adjustment_finds_the_scene_and_leaves_held_keyframes():
    landmarks, truth, xyz = small_map(np.random.default_rng(5), 0.01)
    held = [landmarks.keyframes[i].T_camera_world.copy() for i in (0, 1)]
    cost = landmarks.adjust(free=[2, 3, 4, 5], held=[0, 1], steps=50)
    assert cost < 1e-6
    for i in (0, 1):
        np.testing.assert_array_equal(landmarks.keyframes[i].T_camera_world, held[i])
    for keyframe, T in zip(landmarks.keyframes, truth, strict=True):
        np.testing.assert_allclose(keyframe.T_camera_world, T, atol=1e-4)
    np.testing.assert_allclose(landmarks.xyz[:150], xyz, atol=1e-3)


def test_an_adjustment_without_a_solution_leaves_the_map_and_is_counted():
    landmarks, _, _ = small_map(np.random.default_rng(5), 0.01)
    landmarks.keyframes[3].pixels = landmarks.keyframes[3].pixels.copy()
    landmarks.keyframes[3].pixels[7] = np.nan  # Ceres cannot evaluate the cost
    before = landmarks.copy()
    assert landmarks.adjust(free=[2, 3, 4, 5], held=[0, 1], steps=50) == np.inf
    np.testing.assert_array_equal(landmarks.xyz, before.xyz)
    assert landmarks.unsolved == 1
    other, _, _ = small_map(np.random.default_rng(6), 0.0)
    for keyframe in landmarks.keyframes:
        keyframe.number += 10
    other.absorb(landmarks, np.eye(4))
    assert other.unsolved == 1


def test_bundle_adjustment_finds_the_focal_length():
    landmarks, _, _ = small_map(np.random.default_rng(6), 0.0, Lens.radial(430.0, 0.0, 640, 480))
    landmarks.adjust(range(6), steps=100, refined=["focal"])
    assert landmarks.lens.focal == pytest.approx(500.0, rel=1e-3)


def test_wrong_observations_leave_the_map_and_landmarks_that_nobody_sees_lose_their_place():
    landmarks, _, _ = small_map(np.random.default_rng(7), 0.0)
    for k in range(6):
        keyframe = landmarks.keyframes[k]
        shifted = np.array(keyframe.pixels)
        shifted[0] += 40.0 * (k > 0)  # landmark 0 is right in the first keyframe alone
        shifted[1] += 40.0 * (k == 3)
        keyframe.pixels, keyframe.rays = shifted, landmarks.lens.rays(shifted)
    landmarks.discard_outliers(range(6))
    assert not landmarks.known[0] and landmarks.known[1:150].all()
    assert [1 in keyframe.ids for keyframe in landmarks.keyframes] == [True, True, True, False, True, True]


def test_flow_follows_a_shift_and_gives_up_what_is_gone(box_room, box_walk):
    grey = box_walk.grey[0]
    shifted = np.roll(grey, (3, 7), axis=(0, 1))
    shifted[:, 150:200] = 128
    found = corners(grey, np.zeros((0, 2)), 200)
    assert len(found) > 150
    there, good = flow(grey, shifted, found, found)
    inner = (found > 40).all(axis=1) & (found < (280, 200)).all(axis=1)
    away = (found[:, 0] < 120) | (found[:, 0] > 220)
    # The largest error is 0.07 to 0.16 px over five draws.
    np.testing.assert_allclose(
        (there - found)[good & inner & away], [[7.0, 3.0]] * (good & inner & away).sum(), atol=0.3
    )
    gone = (found[:, 0] > 165) & (found[:, 0] < 180)
    assert good[inner & away].mean() > 0.95 and not good[gone].any()


def test_corners_keep_to_the_mask_and_off_those_taken(box_walk):
    grey, valid = box_walk.grey[0], np.zeros((240, 320), bool)
    valid[:, 100:] = True
    first = corners(grey, np.zeros((0, 2)), 150, valid)
    assert len(first) > 60 and (first[:, 0] > 100).all()
    more = corners(grey, first, 300, valid)
    assert np.linalg.norm(first[:, None] - more[None], axis=2).min() > 4
    assert len(corners(np.full((240, 320), 7, np.uint8), first, 300)) == 0


def test_landmarks_are_found_again_from_another_side_to_a_fraction_of_a_pixel(box_room, box_walk):
    """Frames 0 and 25 are 0.75 m apart; the true place comes from the room's geometry."""
    landmarks = LandmarkMap(Lens.pinhole(box_room.camera))
    T_a, T_b = box_walk.poses[0], box_walk.poses[25]
    at = corners(box_walk.grey[0], np.zeros((0, 2)), 150)
    ids = landmarks.new_ids(len(at))
    landmarks.add_keyframe(Keyframe(0, T_a, box_walk.grey[0], ids, at, landmarks.lens.rays(at)))
    z = box_room.depth(T_a, at)
    landmarks.xyz[ids] = (box_room.camera.unproject(at, z) - T_a[:3, 3]) @ T_a[:3, :3]
    landmarks.known[ids] = True
    truth = landmarks.lens.pixels(landmarks.xyz[ids] @ T_b[:3, :3].T + T_b[:3, 3])
    inside = (truth > 20).all(axis=1) & (truth < (300, 220)).all(axis=1)
    # Seen, and not behind the wall that another part of the corner is on.
    inside &= np.abs(box_room.depth(T_b, truth) - (landmarks.xyz[ids] @ T_b[2, :3] + T_b[2, 3])) < 0.01
    keyframe, pixel, visible = reference_views(landmarks, ids, T_b)
    good = inside & visible
    guess = truth[good] + np.random.default_rng(8).uniform(-4, 4, (good.sum(), 2))
    there, found = align_landmarks(landmarks, ids[good], keyframe[good], pixel[good], box_walk.grey[25], T_b, guess)
    error = np.linalg.norm(there - truth[good], axis=1)[found]
    assert good.sum() > 50 and found.mean() > 0.7
    assert np.median(error) < 0.25 and np.percentile(error, 90) < 1.0
    _, found = align_landmarks(
        landmarks, ids[good], keyframe[good], pixel[good], np.full((240, 320), 90, np.uint8), T_b, guess
    )
    assert not found.any()
    assert not reference_views(landmarks, ids, inverse_se3(T_a))[2].all()
