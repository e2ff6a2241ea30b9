"""Places that are recognised by appearance and then by geometry."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3, inverse_se3, moved_points, moved_pose
from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.klt.frame import corners
from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap
from modp_ti.inputs.klt.recognition import PlaceIndex, Recognition, agreeing, recognised, vocabulary
from modp_ti.inputs.multiview.appearance import vlad
from tests.room import look_at


def views_round(box_room, eye: tuple[float, float, float]) -> list[Keyframe]:
    """Keyframes that look in eight directions from one place."""
    keyframes = []
    for i in range(8):
        way = np.array([np.cos(0.25 * np.pi * i), np.sin(0.25 * np.pi * i), -0.05])
        T = look_at(np.array(eye), np.array(eye) + way)
        nothing = np.zeros((0, 2))
        keyframes.append(Keyframe(i, T, box_room.grey(T), np.zeros(0, np.int64), nothing, nothing))
    return keyframes


def test_the_keyframe_that_looks_alike_is_the_one_that_sees_the_same_wall(box_room):
    there, here = views_round(box_room, (0.0, 0.4, 1.3)), views_round(box_room, (0.4, 0.7, 1.2))
    index = PlaceIndex(0)
    for i, keyframe in enumerate(here):
        keyframe.number += 100
        assert int(index.likeness(keyframe, there).argmax()) == i


def test_a_vocabulary_is_the_same_each_time_and_a_vector_has_length_one():
    descriptors = np.random.default_rng(0).integers(0, 255, (500, 128)).astype(np.uint8)
    words = vocabulary(descriptors, 16, 1)
    np.testing.assert_array_equal(words, vocabulary(descriptors, 16, 1))
    assert np.linalg.norm(vlad(descriptors[:100], words)) == pytest.approx(1.0, abs=1e-6)
    assert not vlad(descriptors[:0], words).any()


def mapped(box_room, poses: list[NDArray[np.float64]], S: NDArray[np.float64], first: int) -> LandmarkMap:
    """The true map of these keyframes, in a world that S leads to."""
    landmarks = LandmarkMap(Lens.pinhole(box_room.camera))
    for i, T in enumerate(poses):
        grey = box_room.grey(T)
        at = corners(grey, np.zeros((0, 2)), 400)
        ids, rays = landmarks.new_ids(len(at)), landmarks.lens.rays(at)
        z = box_room.depth(T, at)
        landmarks.xyz[ids] = moved_points(S, (box_room.camera.unproject(at, z) - T[:3, 3]) @ T[:3, :3])
        landmarks.known[ids] = True
        landmarks.add_keyframe(Keyframe(first + i, moved_pose(S, T), grey, ids, at, rays))
    return landmarks


def test_a_recognised_place_tells_the_similarity_between_two_worlds(box_room, box_walk):
    S = np.diag([0.4, 0.4, 0.4, 1.0]) @ exp_se3([0.5, -1.0, 0.2, 0.3, -0.6, 1.0])
    landmarks = mapped(box_room, box_walk.poses[:1], np.eye(4), 0)
    own = mapped(box_room, box_walk.poses[12:24:6], S, 10)
    found = []
    for by in own.keyframes:
        each = recognised(landmarks, landmarks.keyframes[0], own, by, seed=0)
        assert each is not None
        found.append(each)
        T = inverse_se3(moved_pose(each.S_of_by, by.T_camera_world))
        true = inverse_se3(box_walk.poses[12 + 6 * (by.number - 10)])
        assert np.linalg.norm(T[:3, 3] - true[:3, 3]) < 0.06  # of 4 m
        assert np.cbrt(np.linalg.det(each.S_of_by[:3, :3])) == pytest.approx(1 / 0.4, rel=0.03)
    assert agreeing(found, found[-1]) == found
    wrong = np.diag([1.5, 1.5, 1.5, 1.0]) @ found[0].S_of_by
    other = Recognition(found[0].of, found[0].by, found[0].pairs, wrong, found[0].T_camera_world, found[0].depth)
    assert agreeing([other, found[1]], found[1]) == [found[1]]


def test_another_place_is_not_recognised(box_room):
    here, there = (look_at(np.array([0.0, 0.4, 1.3]), np.array([x, 0.5, 1.2])) for x in (3.0, -3.0))
    landmarks, own = mapped(box_room, [here], np.eye(4), 0), mapped(box_room, [there], np.eye(4), 1)
    assert recognised(landmarks, landmarks.keyframes[0], own, own.keyframes[0], seed=0) is None
