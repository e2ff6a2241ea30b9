"""What a tracker delivers: frames, their pyramids, and corrections."""

from __future__ import annotations

import numpy as np
import pytest

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame, build_pyramid
from fields.geometry.camera import PinholeCamera
from fields.map.keyframes import KeyframeStore

CAMERA = PinholeCamera(10.0, 10.0, 4.0, 3.0, 8, 6)


def frame(**changes: object) -> TrackedFrame:
    values = {
        "index": 0,
        "timestamp": 0.0,
        "name": "a.png",
        "image": np.zeros((6, 8, 3), dtype=np.float32),
        "camera": CAMERA,
        "T_camera_world": np.eye(4),
    }
    return TrackedFrame(**(values | changes))


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"image": np.zeros((8, 6, 3), dtype=np.float32)}, r"a\.png: image is \(8, 6, 3\)"),
        ({"image": np.zeros((6, 8, 3))}, "float64, the camera asks for .* float32"),
        ({"mask": np.ones((6, 7), dtype=bool)}, "mask is"),
        ({"T_camera_world": np.full((4, 4), np.nan)}, "finite 4x4"),
        ({"T_camera_world": np.eye(3)}, "finite 4x4"),
        ({"timestamp": float("nan")}, r"a\.png: timestamp is nan"),
        ({"timestamp": float("inf")}, r"a\.png: timestamp is inf"),
    ],
)
def test_frames_that_do_not_fit_together_are_refused(changes: dict[str, object], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        frame(**changes)


def test_eight_bits_hold_the_image_and_its_mask() -> None:
    image = (np.arange(6 * 8 * 3).reshape(6, 8, 3) / 255).astype(np.float32)
    mask = np.ones((6, 8), dtype=bool)
    mask[2, 3] = False
    rgba = frame(image=image, mask=mask).rgba
    expected = np.arange(6 * 8 * 3).reshape(6, 8, 3)
    np.testing.assert_array_equal(rgba[mask][:, :3], expected[mask])
    assert (rgba[mask][:, 3] == 255).all()
    assert (rgba[2, 3] == 0).all()


def test_colours_beyond_the_range_are_its_ends_and_do_not_wrap() -> None:
    image = np.full((6, 8, 3), [-0.01, 0.5, 1.01], dtype=np.float32)
    np.testing.assert_array_equal(frame(image=image).rgba[0, 0], [0, 128, 255, 255])


# ---- from one's own arrays ------------------------------------------------------------------------------------

POSE = np.diag([1.0, -1.0, -1.0, 1.0])  # looks along -z
ARRAYS = {
    "index": 3,
    "image": np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3),
    "T_camera_world": POSE,
    "intrinsics": (10.0, 11.0, 4.0, 3.0),
    "xyz": [[0.1, 0.2, -2.0], [0.0, 0.0, -4.0]],
    "pixels": [[4.5, 1.9], [4.0, 3.0]],
}


def test_arrays_become_a_frame() -> None:
    made = TrackedFrame.from_arrays(**ARRAYS, ids=np.array([7, 9], np.uint32), timestamp=0.5, held_out=True)
    assert (made.index, made.name, made.timestamp, made.held_out) == (3, "frame 3", 0.5, True)
    assert made.camera == PinholeCamera(10.0, 11.0, 4.0, 3.0, 8, 6)
    np.testing.assert_array_equal(made.rgba[..., :3], ARRAYS["image"])
    np.testing.assert_array_equal(made.T_camera_world, POSE)
    np.testing.assert_array_equal(made.points.ids, [7, 9])
    np.testing.assert_allclose(made.points.depths(made.T_camera_world), [2.0, 4.0])


@pytest.mark.parametrize(
    ("changes", "error", "complaint"),
    [
        ({"image": np.zeros((6, 8, 3))}, TypeError, "image is float64, expected uint8, or float32"),
        ({"image": np.zeros((6, 8), np.uint8)}, ValueError, r"image has shape \(6, 8\), expected \(H, W, 3\)"),
        ({"image": np.full((6, 8, 3), 200, np.float32)}, ValueError, "holds 0 to 1, this one 200 to 200"),
        ({"T_camera_world": np.eye(4)[:3]}, ValueError, "must be a rigid 4x4 matrix"),
        ({"T_camera_world": np.diag([2.0, 2.0, 2.0, 1.0])}, ValueError, "must be a rigid 4x4 matrix"),
        ({"T_camera_world": np.diag([1.0, 1.0, -1.0, 1.0])}, ValueError, "must be a rigid 4x4 matrix"),
        ({"T_camera_world": np.eye(4)}, ValueError, "2 of 2 points lie behind the camera"),
        ({"intrinsics": np.eye(3)}, ValueError, "intrinsics must be four numbers: fx, fy, cx, cy"),
        ({"intrinsics": (0.0, 1.0, 1.0, 1.0)}, ValueError, "focal lengths must be positive"),
        ({"pixels": [[4.5, 1.9]]}, ValueError, r"xyz has shape \(2, 3\), pixels \(1, 2\)"),
        ({"pixels": [[4.5, 1.9], [8.0, 3.0]]}, ValueError, r"pixel 1, \(8.0, 3.0\), is not in the 8x6 image"),
        ({"xyz": np.full((2, 3), np.nan)}, ValueError, "NaN or infinite"),
        ({"ids": [0.5, 1.5]}, ValueError, r"ids are \(2,\) float64, expected \(2,\) integers"),
        ({"mask": np.ones((6, 8), np.uint8)}, TypeError, "mask is uint8, expected bool"),
    ],
)
def test_arrays_that_do_not_fit_are_told_in_one_line(
    changes: dict[str, object], error: type[Exception], complaint: str
) -> None:
    with pytest.raises(error, match=complaint) as told:
        TrackedFrame.from_arrays(**(ARRAYS | changes))
    assert str(told.value).startswith("frame 3: ") and "\n" not in str(told.value)


IMAGE = np.zeros((6, 8, 3), dtype=np.uint8)


def test_a_frame_may_have_no_points() -> None:
    for nothing in ([], np.zeros((0, 3)), ()):
        for ids in (None, []):
            given = TrackedFrame.from_arrays(0, IMAGE, np.eye(4), (10.0, 10.0, 4.0, 3.0), nothing, [], ids)
            assert given.points.xyz.shape == (0, 3) and given.points.pixels.shape == (0, 2) and len(given.points) == 0
    with pytest.raises(ValueError, match=r"^frame 0: xyz"):
        TrackedFrame.from_arrays(0, IMAGE, np.eye(4), (10.0, 10.0, 4.0, 3.0), [], [[1.0, 1.0]])


LARGE = PinholeCamera(800.0, 760.0, 520.0, 240.0, 1024, 512)


def image() -> np.ndarray:
    rgba = np.random.default_rng(0).integers(0, 256, (512, 1024, 4), dtype=np.uint8)
    rgba[..., 3] = 255
    return rgba


def test_a_pixel_is_the_mean_of_those_that_it_covers() -> None:
    rgba = image()
    levels = build_pyramid(rgba, LARGE, 3)
    mean = rgba.reshape(256, 2, 512, 2, 4).astype(float).mean(axis=(1, 3))
    assert [level.rgba.shape for level in levels] == [(512, 1024, 4), (256, 512, 4), (128, 256, 4)]
    np.testing.assert_allclose(levels[1].rgba, mean, atol=0.51)
    assert levels[0].rgba is rgba


def test_a_pixel_is_valid_where_all_that_it_covers_are() -> None:
    rgba = image()
    rgba[10, 21] = 0
    half = build_pyramid(rgba, LARGE, 2)[1].rgba
    assert (half[5, 10] == 0).all()
    assert np.count_nonzero(half[..., 3] == 0) == 1


def test_odd_sides_keep_the_field_of_view() -> None:
    camera = PinholeCamera(400.0, 400.0, 150.5, 130.5, 301, 261)
    half = build_pyramid(np.full((261, 301, 4), 255, dtype=np.uint8), camera, 2)[1].camera
    assert (half.width, half.height) == (150, 130)
    assert half.width / half.fx == pytest.approx(301 / 400.0)
    assert half.height / half.fy == pytest.approx(261 / 400.0)


def test_a_keyframe_at_a_level_is_the_same_view_of_fewer_pixels() -> None:
    points = SparsePoints(np.array([[0.3, -0.2, 2.0]]), LARGE.project(np.array([[0.3, -0.2, 2.0]])), np.array([7]))
    view = np.random.default_rng(1).uniform(size=(512, 1024, 3)).astype(np.float32)
    keyframe = KeyframeStore(levels=3).append(TrackedFrame(0, 0.0, "a", view, LARGE, np.eye(4), points))
    half = keyframe.at_level(1)
    np.testing.assert_allclose(half.points.pixels, half.camera.project(points.xyz))
    assert half.rgba.shape == (256, 512, 4)
    assert half.pyramid[0].rgba is half.rgba
    assert half.view_scale == pytest.approx(2 * keyframe.view_scale)
    assert keyframe.at_level(9).rgba.shape == (128, 256, 4)  # the coarsest there is


def test_a_keyframe_keeps_the_levels_that_are_large_enough() -> None:
    view = np.full((512, 1024, 3), 0.5, dtype=np.float32)
    frame = TrackedFrame(0, 0.0, "a", view, LARGE, np.eye(4))
    for levels, min_side, kept in ((4, 1, 4), (4, 128, 3), (4, 129, 2), (2, 128, 2), (4, 4000, 1)):
        pyramid = KeyframeStore(levels, min_side).append(frame).pyramid
        assert [image.camera.height for image in pyramid] == [512, 256, 128, 64][:kept]


@pytest.mark.parametrize(
    ("index", "T"),
    [(3, np.eye(4)), (np.int32(3), np.eye(4)[None]), ([3], np.eye(4).tolist()), (np.array([3]), np.eye(4, dtype="f4"))],
)
def test_one_frame_may_be_given_plainly(index: object, T: object) -> None:
    correction = PoseCorrection(index, T)
    assert correction.index.tolist() == [3] and correction.index.dtype == np.int64
    assert correction.T_camera_world.shape == (1, 4, 4) and correction.T_camera_world.dtype == np.float64


@pytest.mark.parametrize(
    "given",
    [
        (3.5, np.eye(4)),
        ([], np.zeros((0, 4, 4))),
        ([1, 1], [np.eye(4)] * 2),
        (-1, np.eye(4)),
        (1, np.full((4, 4), np.nan)),
        ([1, 2], np.eye(4)),
        (1, np.eye(4), [2], [[0.0, 0.0, np.inf]]),
        (1, np.eye(4), [2], []),
    ],
)
def test_corrections_that_do_not_fit_together_are_refused_in_one_line(given: tuple) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        PoseCorrection(*given)
