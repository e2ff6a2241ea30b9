"""Keyframes: what they share, what moves with them, masks, and their state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3, motion_around
from fields.map.keyframes import KeyframeRows, KeyframeStore, RunningMedian, keyframe_arrays
from pipelines.select.keyframes import SeenPoints, covisibility

CAMERA = PinholeCamera(10.0, 40.0, 4.0, 3.0, 8, 6)


def frame(index: int, depths: tuple[float, ...] = (2.0, 4.0, 6.0), T: np.ndarray | None = None) -> TrackedFrame:
    """A frame whose points lie at the given depths on the optical axis."""
    T = np.eye(4) if T is None else T
    camera_points = np.array([[0.0, 0.0, z] for z in depths]).reshape(-1, 3)
    xyz = (camera_points - T[:3, 3]) @ T[:3, :3]
    points = SparsePoints(xyz, np.full((len(xyz), 2), 3.0), np.arange(len(xyz)))
    return TrackedFrame(index, index / 30, f"{index}", np.zeros((6, 8, 3), np.float32), CAMERA, T, points)


def test_the_scene_depth_is_the_median_over_keyframes() -> None:
    store = KeyframeStore()
    for index, depth in enumerate((1.0, 9.0, 2.0)):
        store.append(frame(index, (depth,)))
    assert store.scene_depth == pytest.approx(2.0)
    assert store.append(frame(3, ())).median_depth == pytest.approx(2.0)


def test_a_new_keyframe_starts_at_the_mean_error_and_the_first_at_one() -> None:
    store = KeyframeStore()
    first, second = store.append(frame(0)), store.append(frame(1))
    assert (first.error, second.error) == (1.0, 1.0)
    first.error, second.error = 0.1, 0.3
    assert store.append(frame(2)).error == pytest.approx(0.2)


def test_frames_between_keyframes_share_their_corrections() -> None:
    store = KeyframeStore()
    T = exp_se3([1, 0, 0, 0, 0.3, 0])
    a, b = store.append(frame(10)), store.append(frame(20))
    twist = np.array([0.2, -0.1, 0.3, 0.01, 0.02, -0.03])
    a.T_camera_world = exp_se3(twist) @ a.T_tracked
    b.T_camera_world = exp_se3(3 * twist) @ b.T_tracked
    for index, share in ((0, 1.0), (10, 1.0), (15, 2.0), (20, 3.0), (99, 3.0)):
        np.testing.assert_allclose(store.corrected(index, T), exp_se3(share * twist) @ T, atol=1e-12)


def test_the_views_of_a_rig_share_corrections_with_their_own_keyframes_only() -> None:
    store = KeyframeStore()
    T = exp_se3([1, 0, 0, 0, 0.3, 0])
    twists = {0: [0.2, 0, 0, 0, 0, 0], 1: [0, 0.1, 0, 0, 0, 0.1], 6: [0.4, 0, 0, 0, 0, 0]}
    for index, twist in twists.items():
        keyframe = store.append(replace(frame(index), views=3))
        keyframe.T_camera_world = exp_se3(twist) @ keyframe.T_tracked
    for index, motion in ((3, exp_se3([0.3, 0, 0, 0, 0, 0])), (4, exp_se3(twists[1])), (5, np.eye(4))):
        np.testing.assert_allclose(store.corrected(index, T), motion @ T, atol=1e-12)
    assert [keyframe.index for keyframe in store.before(9, 5)] == [0, 6]
    assert [keyframe.index for keyframe in store.before(6, 5)] == [0]
    assert [keyframe.index for keyframe in store.before(7, 1)] == [1]
    assert store.before(8, 1) == []


def test_exposure_is_interpolated_between_keyframes_and_the_nearest_outside() -> None:
    store = KeyframeStore()
    assert store.exposure_at(0) is None
    for index, value in ((2, 1.0), (6, 3.0), (8, 3.0)):
        store.append(frame(index)).exposure = np.full((3, 4), value)
    expected = {0: 1.0, 2: 1.0, 3: 1.5, 5: 2.5, 6: 3.0, 7: 3.0, 20: 3.0}
    for index, value in expected.items():
        np.testing.assert_allclose(store.exposure_at(index), value)


def test_nothing_is_interpolated_between_two_places() -> None:
    """The second place begins at frame 20. Frames before it take after the nearest keyframe."""
    store = KeyframeStore()
    twist = np.array([0.2, -0.1, 0.3, 0.01, 0.02, -0.03])
    for index, value, share in ((10, 1.0, 1.0), (20, 3.0, 4.0), (22, 5.0, 4.0)):
        view = store.append(frame(index))
        view.exposure = np.full((3, 4), value)
        view.T_camera_world = exp_se3(share * twist) @ view.T_tracked
    assert store.place_begins == 0
    store.begins.add(20)
    assert store.place_begins == 20
    for index, value, share in ((10, 1.0, 1.0), (14, 1.0, 1.0), (16, 3.0, 4.0), (20, 3.0, 4.0), (21, 4.0, 4.0)):
        np.testing.assert_allclose(store.exposure_at(index), value)
        np.testing.assert_allclose(store.corrected(index, np.eye(4)), exp_se3(share * twist), atol=1e-12)


def test_a_revised_keyframe_keeps_its_refinement_and_sees_the_same() -> None:
    store = KeyframeStore()
    keyframe = store.append(frame(0, T=exp_se3([1, 2, 3, 0.1, 0.2, 0.3])))
    keyframe.T_camera_world = exp_se3([0.02, 0.01, -0.03, 0.002, 0.001, 0.004]) @ keyframe.T_tracked
    refinement, points = keyframe.correction, keyframe.points
    seen = points.xyz @ keyframe.T_camera_world[:3, :3].T + keyframe.T_camera_world[:3, 3]
    T = exp_se3([-0.5, 0.3, 2, -0.4, 0.1, 0])
    before = keyframe.T_tracked
    S = motion_around(before, T, 1.5)
    store.trajectory.revise({0: T})
    keyframe.follow(before, S)
    store.take_in_depths()
    np.testing.assert_array_equal(keyframe.T_tracked, T)
    refinement[:3, 3] *= 1.5
    np.testing.assert_allclose(keyframe.correction, refinement, atol=1e-12)
    now = keyframe.points.xyz @ keyframe.T_camera_world[:3, :3].T + keyframe.T_camera_world[:3, 3]
    np.testing.assert_allclose(now, 1.5 * seen, atol=1e-12)
    assert store.scene_depth == keyframe.median_depth == pytest.approx(6.0)
    keyframe.revise_points(SparsePoints(now @ T[:3, :3], points.pixels, points.ids))
    assert keyframe.median_depth == pytest.approx(np.median(now[:, 2]) + T[2, 3])


def test_kinds_of_keyframes_differ_also_after_they_were_saved() -> None:
    store, again = KeyframeStore(), KeyframeStore()
    for index in range(5):
        store.append(frame(index), is_between=index in (1, 3, 4))
    rows = KeyframeRows(keyframe_arrays(store))
    for index in range(5):
        rows.put(frame(index), again)
    for one in (store, again):
        assert [view.index for view in one.selected] == [0, 2] and one.latest == 2
        assert [view.is_between for view in one] == [False, True, False, True, True]


def masked_store() -> KeyframeStore:
    """Three keyframes with a pyramid; of the middle one the left half is masked, and the last row is invalid."""
    camera = PinholeCamera(80.0, 80.0, 32.0, 32.0, 64, 64)
    valid = np.ones((64, 64), dtype=bool)
    valid[-1] = False
    store = KeyframeStore(levels=2)
    for i in range(3):
        image = np.full((64, 64, 3), 0.5, np.float32)
        store.append(TrackedFrame(i, i / 30, f"{i}", image, camera, np.eye(4), frame(i).points, mask=valid))
    mask = np.full((16, 16), 255, dtype=np.uint8)
    mask[:, :8] = 0
    store.mask(store[1], mask)
    return store


def test_a_mask_weights_every_level_of_the_image_and_can_be_lifted() -> None:
    store = masked_store()
    view, plain = store[1], store[0]
    for level, width in ((0, 64), (1, 32)):
        alpha, before = view.image(level).rgba[..., 3], plain.image(level).rgba[..., 3]
        assert (alpha[:, : width // 2 - 4] == 0).all()
        np.testing.assert_array_equal(alpha[:, width // 2 + 4 :], before[:, width // 2 + 4 :])
        np.testing.assert_array_equal(view.image(level).rgba[..., :3], plain.image(level).rgba[..., :3])
        assert view.whole_image(level) is view.unmasked[level]
    assert view.rgba is view.image(0).rgba
    assert (view.rgba[-1] == plain.rgba[-1]).all()  # invalid before, invalid now
    store.mask(view, None)
    assert view.transient is None and view.unmasked == ()
    np.testing.assert_array_equal(view.rgba, plain.rgba)


def test_a_mask_counts_towards_the_memory() -> None:
    store = masked_store()
    view = store[1]
    with_mask = store.nbytes
    store.mask(view, view.transient)  # again: not counted twice
    assert store.nbytes == with_mask
    store.mask(view, None)
    assert with_mask - store.nbytes == sum(image.rgba.nbytes for image in view.pyramid)


def test_masks_are_saved_and_restored() -> None:
    store = masked_store()
    arrays = keyframe_arrays(store)
    again, rows = KeyframeStore(levels=2), KeyframeRows(arrays)
    plain = KeyframeStore(levels=2)
    for view in store:
        whole = view.whole_image(0).rgba
        image = (whole[..., :3] / 255).astype(np.float32)
        source = TrackedFrame(view.index, 0.0, "", image, view.camera, np.eye(4), view.points, mask=whole[..., 3] > 0)
        rows.put(source, again)
        plain.append(source)
    assert [view.transient is None for view in again] == [True, False, True]
    for view, expected in zip(again, store, strict=True):
        for level in range(2):
            np.testing.assert_array_equal(view.image(level).rgba, expected.image(level).rgba)
    assert again.nbytes == store.nbytes
    assert "transient" not in keyframe_arrays(plain)


NARROW = PinholeCamera(10.0, 10.0, 10.0, 10.0, 20, 20)  # sees |x| < z and |y| < z


def view(xyz: list[list[float]], x: float = 0.0) -> SeenPoints:
    """A camera at (x, 0, 0) with these tracked points."""
    T = np.eye(4)
    T[0, 3] = -x
    return SeenPoints(NARROW, T, np.array(xyz, dtype=np.float64).reshape(-1, 3))


def test_covisibility_is_the_shared_part() -> None:
    # Both see the two in the middle; each has one that the other does not see.
    a = view([[0, 0, 2], [0.5, 0, 2], [-1.9, 0, 2]])
    b = view([[0, 0, 2], [0.5, 0, 2], [2.9, 0, 2]], x=1.0)
    assert a.count(b.xyz) == b.count(a.xyz) == 2
    assert covisibility(a, b) == pytest.approx(2 / (2 + 1 + 1))


def test_points_beyond_the_farthest_are_not_seen() -> None:
    a = view([[0, 0, 2]])
    assert a.count(np.array([[0, 0, 2.0], [0, 0, 2.5], [0, 0, -1.0], [5, 0, 2]])) == 1


def test_a_view_covers_itself_and_nothing_covers_no_points() -> None:
    a = view([[0, 0, 2], [0.5, 0, 2]])
    assert covisibility(a, a) == 1.0
    assert covisibility(a, view([])) == 0.1


def test_it_is_the_median_of_what_came_so_far() -> None:
    values = np.random.default_rng(0).choice(40, 101).astype(float) / 7
    median = RunningMedian()
    for n, value in enumerate(values.tolist(), 1):
        median.add(value)
        assert len(median) == n
        assert median.value == np.median(values[:n])
