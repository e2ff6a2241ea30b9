from __future__ import annotations

import numpy as np
import pytest

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera

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


def test_points_that_do_not_fit_together_are_refused() -> None:
    with pytest.raises(ValueError, match="disagree in number"):
        SparsePoints(np.zeros((2, 3)), np.zeros((3, 2)), np.zeros(2, dtype=np.int64))
    with pytest.raises(ValueError, match="NaN"):
        SparsePoints(np.full((1, 3), np.nan), np.zeros((1, 2)), np.zeros(1, dtype=np.int64))


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


def test_points_without_numbers_are_all_different() -> None:
    frames = [TrackedFrame.from_arrays(**{**ARRAYS, "index": i}) for i in (0, 1, 500)]
    ids = np.concatenate([made.points.ids for made in frames])
    assert len(set(ids.tolist())) == 6 and (ids >= 0).all()
    assert [made.timestamp for made in frames] == [0.0, 1.0, 500.0]


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


def test_an_id_that_stands_twice_is_named() -> None:
    xyz, pixels = [[0.0, 0.0, 2.0]] * 3, [[1.0, 1.0]] * 3
    with pytest.raises(ValueError, match=r"^frame 3: id 7 [^\n]*$"):
        TrackedFrame.from_arrays(3, IMAGE, np.eye(4), (10.0, 10.0, 4.0, 3.0), xyz, pixels, [7, 2, 7])
