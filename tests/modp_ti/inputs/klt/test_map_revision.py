"""What a map takes over from the adjustment of an earlier copy."""

from __future__ import annotations

import numpy as np

from fields.geometry.se3 import exp_se3, moved_points, moved_pose
from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap
from modp_ti.inputs.klt.loop_closing import carry_over

S = np.diag([1.3, 1.3, 1.3, 1.0]) @ exp_se3([0.3, -0.2, 0.5, 0.2, 0.4, -0.1])


def seen_from(landmarks: LandmarkMap, number: int, ids: np.ndarray) -> Keyframe:
    """A keyframe on a straight way that sees landmarks exactly where they are."""
    T = exp_se3([-0.1 * number, 0, 0.02 * number, 0, 0.01 * number, 0])
    pixels = landmarks.lens.pixels(landmarks.xyz[ids] @ T[:3, :3].T + T[:3, 3])
    return Keyframe(number, T, np.zeros((240, 320), np.uint8), ids, pixels, landmarks.lens.rays(pixels))


def small_map() -> LandmarkMap:
    rng = np.random.default_rng(0)
    landmarks = LandmarkMap(Lens.radial(300.0, 0.0, 320, 240))
    ids = landmarks.new_ids(33)
    landmarks.xyz[ids] = np.c_[rng.uniform(-1, 1, (33, 2)), rng.uniform(3, 5, 33)]
    landmarks.known[ids] = True
    for number in range(4):
        landmarks.add_keyframe(seen_from(landmarks, number, ids[number : number + 30]))
    return landmarks


def test_a_map_that_has_not_grown_becomes_the_adjusted_copy():
    landmarks = small_map()
    before = landmarks.copy()
    after = before.copy()
    rng = np.random.default_rng(1)
    after.xyz[:33] += rng.normal(0, 1e-3, (33, 3))
    for keyframe in after.keyframes:
        keyframe.T_camera_world[:3, 3] += rng.normal(0, 1e-3, 3)
    carry_over(landmarks, before, after)
    np.testing.assert_allclose(landmarks.xyz[:33], after.xyz[:33], atol=1e-12)
    for keyframe, expected in zip(landmarks.keyframes, after.keyframes, strict=True):
        np.testing.assert_allclose(keyframe.T_camera_world, expected.T_camera_world, atol=1e-12)


def test_what_has_come_since_moves_along_and_new_features_keep_apart():
    landmarks = small_map()
    before = landmarks.copy()
    after = before.copy()
    after.move([S] * 4)
    connecting = after.new_ids(1)  # a feature of the first and the last keyframe, which the adjustment has added
    for k in (0, 3):
        pixel = np.array([[100.0 + k, 50.0]])
        after.keyframes[k].append(connecting, pixel, after.lens.rays(pixel))
        after.note_observations(k, connecting, pixel)

    own = landmarks.new_ids(5)  # meanwhile the map has got landmarks with the same ids, and a keyframe
    landmarks.xyz[own], landmarks.known[own] = landmarks.xyz[28:33] + 0.05, True
    landmarks.add_keyframe(seen_from(landmarks, 4, np.r_[np.arange(10, 33), own]))
    landmarks.add_keyframe(seen_from(landmarks, 5, np.r_[np.arange(12, 33), own]))
    xyz, poses = landmarks.xyz.copy(), [keyframe.T_camera_world.copy() for keyframe in landmarks.keyframes]
    carry_over(landmarks, before, after)

    np.testing.assert_allclose(landmarks.xyz[:38], moved_points(S, xyz[:38]), atol=1e-9)
    for keyframe, T in zip(landmarks.keyframes, poses, strict=True):
        np.testing.assert_allclose(keyframe.T_camera_world, moved_pose(S, T), atol=1e-9)
        np.testing.assert_allclose(keyframe.scale, 1.3)
    first, last = landmarks.keyframes[0], landmarks.keyframes[3]
    (new,) = set(first.ids) - set(range(38))
    assert list(last.pixels[last.ids == new][0]) == [103.0, 50.0]
    assert landmarks.first[new] == 0 and landmarks.last[new] == 3
    assert not set(own) & set(first.ids)
