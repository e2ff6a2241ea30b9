"""Poses, two views, patches, maps and recognised places of scenes that are known exactly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3, inverse_se3, moved_points, moved_pose, scale_of
from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.klt.initialisation import two_views
from modp_ti.inputs.klt.landmark_map import LandmarkMap, triangulated
from modp_ti.inputs.klt.localisation import align_landmarks, reference_views
from modp_ti.inputs.klt.loop_closing import carry_over
from modp_ti.inputs.klt.recognition import PlaceIndex, Recognition, agreeing, recognised
from modp_ti.inputs.multiview.frame import Frame, corners, flow
from modp_ti.inputs.multiview.reprojection import pose_from_points, ray_errors, refine_pose
from tests.room import look_at

LENS = Lens.pinhole(PinholeCamera(500.0, 500.0, 320.0, 240.0, 640, 480))
S = np.diag([1.3, 1.3, 1.3, 1.0]) @ exp_se3([0.3, -0.2, 0.5, 0.2, 0.4, -0.1])


def cloud(rng: np.random.Generator, count: int = 200) -> NDArray[np.float64]:
    return np.c_[rng.uniform(-2, 2, (count, 2)), rng.uniform(4, 8, count)]


def rays(T: NDArray[np.float64], xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    p = xyz @ T[:3, :3].T + T[:3, 3]
    return p[:, :2] / p[:, 2:]


def pixels(T: NDArray[np.float64], xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    return 500.0 * rays(T, xyz) + (320.0, 240.0)


def way(i: int) -> NDArray[np.float64]:
    return exp_se3([-0.25 * i, 0.05 * i * i, 0.02 * i, 0, 0.02 * i, 0.01 * i])


def add_keyframe(landmarks: LandmarkMap, number: int, T: NDArray[np.float64], ids: NDArray[np.int64]) -> None:
    """A keyframe that sees landmarks exactly where the world has them."""
    at = pixels(T, landmarks.xyz[ids])
    landmarks.add_keyframe(Frame(number, np.zeros((480, 640), np.uint8), None, ids, at), T)


def small_map(lens: Lens = LENS, numbers: Sequence[int] = range(6)) -> tuple[LandmarkMap, NDArray[np.float64]]:
    """Six keyframes of 150 landmarks, and the landmarks."""
    landmarks, xyz = LandmarkMap(lens), cloud(np.random.default_rng(5), 150)
    ids = landmarks.new_ids(150)
    landmarks.xyz[ids], landmarks.known[ids] = xyz, True
    for i, number in enumerate(numbers):
        add_keyframe(landmarks, number, way(i), ids)
    return landmarks, xyz


def test_a_pose_is_found_and_refined_past_wrong_matches():
    rng = np.random.default_rng(0)
    xyz, T = cloud(rng), exp_se3([0.4, -0.2, 0.3, 0.1, 0.3, -0.2])
    seen = rays(T, xyz)
    seen[::2] += rng.uniform(0.05, 0.3, (100, 2))
    found, again = (pose_from_points(xyz, seen, 2 / 500, seed=1) for _ in range(2))
    assert found is not None and again is not None
    np.testing.assert_allclose(found[0], T, atol=1e-6)
    np.testing.assert_array_equal(found[1], np.arange(200) % 2 == 1)
    np.testing.assert_array_equal(found[0], again[0])
    assert pose_from_points(xyz[:3], seen[:3], 0.01, seed=0) is None

    seen = rays(T, xyz)
    seen[:30] += 0.1
    start = exp_se3([0.05, -0.04, 0.03, 0.01, 0.02, -0.01]) @ T
    np.testing.assert_allclose(refine_pose(start, xyz, seen, 1 / 500, steps=30), T, atol=2e-3)
    assert np.isinf(ray_errors(np.eye(4), np.array([[0.0, 0.0, -2.0]]), np.zeros((1, 2)))[0])


@pytest.mark.parametrize("scene", ["cloud", "plane", "turn"])
def test_two_views_tell_the_motion_before_a_cloud_and_a_plane_but_not_of_a_turn(scene):
    rng = np.random.default_rng(2)
    xyz = cloud(rng)
    if scene == "plane":
        xyz[:, 2] = 5 + 0.4 * xyz[:, 0] + 0.1 * xyz[:, 1]
    T = exp_se3([0, 0, 0, 0.02, 0.1, 0.05] if scene == "turn" else [0.6, 0.1, 0.1, 0.02, -0.08, 0.01])
    noise = 0.2 * rng.standard_normal((2, 200, 2))
    found = two_views(LENS, pixels(np.eye(4), xyz) + noise[0], pixels(T, xyz) + noise[1], 2.0, seed=0)
    if scene == "turn":
        assert found is None
        return
    assert found is not None
    T_b_a, points, good = found
    scale = np.linalg.norm(T[:3, 3])
    assert T_b_a[:3, 3] @ T[:3, 3] / scale > np.cos(np.radians(3))
    np.testing.assert_allclose(T_b_a[:3, :3], T[:3, :3], atol=0.01)
    assert np.median(np.linalg.norm(scale * points - xyz, axis=1)[good]) < 0.35  # 0.016 to 0.161, 12 draws


@pytest.mark.parametrize("focal", [0.7, 1.0, 1.4])
def test_no_turn_is_taken_for_motion_whatever_the_focal_length(focal):
    xyz = cloud(np.random.default_rng(3))
    lens = Lens.radial(focal * LENS.focal, 0.0, LENS.camera.width, LENS.camera.height)
    for angle in (0.05, 0.15, 0.3):
        T = exp_se3([0, 0, 0, 0.3 * angle, angle, 0.1 * angle])
        noise = 0.2 * np.random.default_rng(5).standard_normal((2, 200, 2))
        assert two_views(lens, pixels(np.eye(4), xyz) + noise[0], pixels(T, xyz) + noise[1], 1.0, seed=0) is None


def test_motion_along_the_view_is_told_where_most_of_the_features_are_far_away():
    xyz = cloud(np.random.default_rng(6))
    xyz[60:] *= 200
    T = exp_se3([0.05, 0.02, -1.0, 0.01, 0.03, -0.02])
    noise = 0.3 * np.random.default_rng(7).standard_normal((2, 200, 2))
    found = two_views(LENS, pixels(np.eye(4), xyz) + noise[0], pixels(T, xyz) + noise[1], 1.15, seed=0)
    assert found is not None
    T_b_a, _, good = found
    assert T_b_a[:3, 3] @ T[:3, 3] / np.linalg.norm(T[:3, 3]) > np.cos(np.radians(2))
    assert not good[60:].any() and good[:60].sum() > 40


def test_triangulation_asks_for_parallax():
    xyz = cloud(np.random.default_rng(4), 50)
    for baseline, reliable in ((0.5, True), (0.01, False)):
        T = exp_se3([-baseline, 0, 0, 0, 0, 0])
        found, good = triangulated(np.eye(4), T, rays(np.eye(4), xyz), rays(T, xyz), 2 / 500)
        assert (good == reliable).all()
        if reliable:
            np.testing.assert_allclose(found, xyz, atol=1e-9)


@pytest.mark.parametrize("apart", [False, True])
def test_bundle_adjustment_finds_the_scene_and_leaves_held_keyframes_in_a_process_of_its_own_too(apart):
    landmarks, xyz = small_map()
    rng = np.random.default_rng(6)
    landmarks.xyz[:150] += 0.01 * rng.standard_normal(xyz.shape)
    for keyframe in landmarks.keyframes[2:]:
        keyframe.T_camera_world = exp_se3(0.01 * rng.standard_normal(6)) @ keyframe.T_camera_world
    assert landmarks.adjust(free=[2, 3, 4, 5], held=[0, 1], steps=50, apart=apart) < 1e-6
    for i, keyframe in enumerate(landmarks.keyframes):
        np.testing.assert_allclose(keyframe.T_camera_world, way(i), atol=1e-4 if i > 1 else 0)
    np.testing.assert_allclose(landmarks.xyz[:150], xyz, atol=1e-3)


def test_bundle_adjustment_finds_the_focal_length():
    landmarks, _ = small_map(Lens.radial(430.0, 0.0, 640, 480))
    landmarks.adjust(range(6), steps=100, refined=["focal"])
    assert landmarks.lens.focal == pytest.approx(500.0, rel=1e-3)


@pytest.mark.parametrize("fails", ["Ceres", "the process"])
def test_an_adjustment_without_a_solution_leaves_the_map_and_is_counted(monkeypatch, fails):
    landmarks, xyz = small_map()
    if fails == "Ceres":
        landmarks.keyframes[3].pixels[7] = np.nan
    monkeypatch.setattr("modp_ti.inputs.multiview.bundle_adjustment.CODE", "import os; os._exit(137)")
    assert landmarks.adjust([2, 3, 4, 5], [0, 1], steps=50, apart=fails == "the process") == np.inf
    np.testing.assert_array_equal(landmarks.xyz[:150], xyz)
    assert landmarks.unsolved == 1


def test_wrong_observations_leave_the_map_and_landmarks_that_nobody_sees_lose_their_place():
    landmarks, _ = small_map()
    for k, keyframe in enumerate(landmarks.keyframes):
        keyframe.pixels[0] += 40.0 * (k > 0)  # landmark 0 is right in the first keyframe alone
        keyframe.pixels[1] += 40.0 * (k == 3)
        keyframe.rays = landmarks.lens.rays(keyframe.pixels)
    landmarks.discard_outliers(range(6))
    assert not landmarks.known[0] and landmarks.known[1:150].all()
    assert [1 in keyframe.ids for keyframe in landmarks.keyframes] == [True, True, True, False, True, True]


def test_a_map_keeps_its_observations_when_another_absorbs_it():
    (own, xyz), (other, _) = small_map(numbers=range(10, 16)), small_map(numbers=range(6))  # the other is earlier
    other.unsolved = 2
    offset = own.absorb(other, S)
    assert [keyframe.number for keyframe in own.keyframes] == [*range(6), *range(10, 16)]
    np.testing.assert_allclose(own.xyz[:150], xyz)
    np.testing.assert_allclose(own.xyz[offset : offset + 150], moved_points(S, xyz))
    for k, keyframe in enumerate(own.keyframes):
        np.testing.assert_allclose(keyframe.T_camera_world, moved_pose(S, way(k)) if k < 6 else way(k - 6), atol=1e-12)
        assert ray_errors(keyframe.T_camera_world, own.xyz[keyframe.ids], keyframe.rays).max() < 1e-9
        assert (own.first[keyframe.ids] <= k).all() and (own.last[keyframe.ids] >= k).all()
    # The first observation is that of the first keyframe of its own map.
    assert own.first[0] == 6 and own.first[offset] == 0 and own.unsolved == 2


@pytest.mark.parametrize("has_grown", [False, True])
def test_a_map_moves_like_the_adjusted_copy_and_what_has_come_since_moves_along(has_grown):
    landmarks, _ = small_map()
    before = landmarks.copy()
    after = before.copy()
    after.move([S] * 6)
    connecting = after.new_ids(1)  # a feature of the first and the fourth keyframe, which the adjustment has added
    for k in (0, 3):
        after.observe(k, connecting, np.array([[100.0 + k, 50.0]]))
    if has_grown:  # the map has got landmarks with the same ids, and keyframes
        own = landmarks.new_ids(5)
        landmarks.xyz[own], landmarks.known[own] = landmarks.xyz[145:150] + 0.05, True
        for number in (6, 7):
            add_keyframe(landmarks, number, way(number), np.r_[np.arange(10, 150), own])
    count, xyz, poses = landmarks.count, landmarks.xyz.copy(), [k.T_camera_world.copy() for k in landmarks.keyframes]
    carry_over(landmarks, before, after)
    np.testing.assert_allclose(landmarks.xyz[:count], moved_points(S, xyz[:count]), atol=1e-9)
    for keyframe, T in zip(landmarks.keyframes, poses, strict=True):
        np.testing.assert_allclose(keyframe.T_camera_world, moved_pose(S, T), atol=1e-9)
        np.testing.assert_allclose(keyframe.scale, 1.3)
    first, fourth = landmarks.keyframes[0], landmarks.keyframes[3]
    (new,) = set(first.ids) - set(range(count))
    assert list(fourth.pixels[fourth.ids == new][0]) == [103.0, 50.0]
    assert landmarks.first[new] == 0 and landmarks.last[new] == 3


def test_flow_follows_a_shift_and_gives_up_what_is_gone(box_walk):
    grey = box_walk.grey[0]
    shifted = np.roll(grey, (3, 7), axis=(0, 1))
    shifted[:, 150:200] = 128
    found = corners(grey, np.zeros((0, 2)), 200)
    assert len(found) > 150
    there, good = flow(grey, shifted, found, found)
    inner = (found > 40).all(axis=1) & (found < (280, 200)).all(axis=1)
    away = inner & ((found[:, 0] < 120) | (found[:, 0] > 220))
    # The largest error is 0.07 to 0.16 px over five draws.
    np.testing.assert_allclose((there - found)[good & away], [[7.0, 3.0]] * (good & away).sum(), atol=0.3)
    gone = (found[:, 0] > 165) & (found[:, 0] < 180)
    assert good[away].mean() > 0.95 and not good[gone].any()


def test_corners_keep_to_the_mask_and_off_those_taken(box_walk):
    grey, valid = box_walk.grey[0], np.zeros((240, 320), bool)
    valid[:, 100:] = True
    first = corners(grey, np.zeros((0, 2)), 150, valid)
    assert len(first) > 60 and (first[:, 0] > 100).all()
    more = corners(grey, first, 300, valid)
    assert np.linalg.norm(first[:, None] - more[None], axis=2).min() > 4
    assert len(corners(np.full((240, 320), 7, np.uint8), first, 300)) == 0


def mapped(box_room, poses: list[NDArray[np.float64]], world: NDArray[np.float64], first: int) -> LandmarkMap:
    """The true map of these keyframes, in a world that the similarity leads to."""
    landmarks = LandmarkMap(Lens.pinhole(box_room.camera))
    for i, T in enumerate(poses):
        grey = box_room.grey(T)
        at = corners(grey, np.zeros((0, 2)), 400)
        ids = landmarks.new_ids(len(at))
        local = box_room.camera.unproject(at, box_room.depth(T, at))
        landmarks.xyz[ids] = moved_points(world, (local - T[:3, 3]) @ T[:3, :3])
        landmarks.known[ids] = True
        landmarks.add_keyframe(Frame(first + i, grey, None, ids, at), moved_pose(world, T))
    return landmarks


def test_landmarks_are_found_again_from_another_side_to_a_fraction_of_a_pixel(box_room, box_walk):
    """Frames 0 and 25 are 0.75 m apart; the true place comes from the room's geometry."""
    T_a, T_b = box_walk.poses[0], box_walk.poses[25]
    landmarks = mapped(box_room, [T_a], np.eye(4), 0)
    ids = landmarks.keyframes[0].ids
    truth = landmarks.lens.pixels(landmarks.xyz[ids] @ T_b[:3, :3].T + T_b[:3, 3])
    inside = (truth > 20).all(axis=1) & (truth < (300, 220)).all(axis=1)
    # Seen, and not behind the wall that another part of the corner is on.
    inside &= np.abs(box_room.depth(T_b, truth) - (landmarks.xyz[ids] @ T_b[2, :3] + T_b[2, 3])) < 0.01
    keyframe, pixel, visible = reference_views(landmarks, ids, T_b)
    good = inside & visible
    guess = truth[good] + np.random.default_rng(8).uniform(-4, 4, (good.sum(), 2))
    arguments = landmarks, ids[good], keyframe[good], pixel[good]
    there, found = align_landmarks(*arguments, box_walk.grey[25], T_b, guess)
    error = np.linalg.norm(there - truth[good], axis=1)[found]
    assert good.sum() > 50 and found.mean() > 0.7
    assert np.median(error) < 0.25 and np.percentile(error, 90) < 1.0
    assert not align_landmarks(*arguments, np.full((240, 320), 90, np.uint8), T_b, guess)[1].any()
    assert not reference_views(landmarks, ids, inverse_se3(T_a))[2].all()


def test_the_keyframe_that_looks_alike_is_the_one_that_sees_the_same_wall(box_room):
    ways = [np.array([np.cos(0.25 * np.pi * i), np.sin(0.25 * np.pi * i), -0.05]) for i in range(8)]
    there, here = (
        mapped(box_room, [look_at(np.array(eye), eye + way) for way in ways], np.eye(4), first).keyframes
        for first, eye in ((0, (0.0, 0.4, 1.3)), (100, (0.4, 0.7, 1.2)))
    )
    index = PlaceIndex(0)
    assert [index.alike(keyframe, there, 1) for keyframe in here] == [[i] for i in range(8)]


def test_a_recognised_place_tells_the_similarity_between_two_worlds_and_another_place_is_not_recognised(
    box_room, box_walk
):
    world = np.diag([0.4, 0.4, 0.4, 1.0]) @ exp_se3([0.5, -1.0, 0.2, 0.3, -0.6, 1.0])
    landmarks = mapped(box_room, box_walk.poses[:1], np.eye(4), 0)
    own = mapped(box_room, box_walk.poses[12:24:6], world, 10)
    found = []
    for by, true in zip(own.keyframes, box_walk.poses[12:24:6], strict=True):
        each = recognised(landmarks, landmarks.keyframes[0], own, by, seed=0)
        assert each is not None
        found.append(each)
        T = moved_pose(each.S_of_by, by.T_camera_world)
        assert np.linalg.norm(inverse_se3(T)[:3, 3] - inverse_se3(true)[:3, 3]) < 0.06  # of 4 m
        assert scale_of(each.S_of_by) == pytest.approx(1 / 0.4, rel=0.03)
    assert agreeing(found, found[-1]) == found
    one = found[0]
    wrong = np.diag([1.5, 1.5, 1.5, 1.0]) @ one.S_of_by
    other = Recognition(one.of, one.by, one.pairs, wrong, one.T_camera_world, one.depth)
    assert agreeing([other, found[1]], found[1]) == [found[1]]
    away = mapped(box_room, [look_at(np.array([0.0, 0.4, 1.3]), np.array([-3.0, 0.5, 1.2]))], np.eye(4), 1)
    assert recognised(landmarks, landmarks.keyframes[0], away, away.keyframes[0], seed=0) is None
