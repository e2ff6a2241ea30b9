"""Messages are read by the meaning that ROS gives their fields: encodings, lenses, clouds, and the frames' tree."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modp_ti.files.errors import InputError
from modp_ti.inputs.bags.messages import camera_of_info, cloud_points, picture, picture_size
from modp_ti.inputs.bags.transforms import FrameTree, Motion
from tests.samples.bags import START, Messages

MAKE, MAKE_ROS1 = Messages(), Messages("ros1")
RGB = np.random.default_rng(0).integers(0, 255, (6, 8, 3)).astype(np.uint8)
ALPHA = np.full((6, 8, 1), 9, np.uint8)
GREY = RGB[..., 1]
K = np.array([[300.0, 0, 161.5], [0, 298.0, 118.25], [0, 0, 1]])
COEFFICIENTS = (0.1, -0.05, 0.002, -0.001, 0.01, 0.02, -0.01, 0.003)
RAYS = np.random.default_rng(1).uniform(-0.5, 0.5, (40, 2))


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "values", "shown"),
    [
        ("rgb8", RGB, RGB),
        ("bgr8", RGB[..., ::-1], RGB),
        ("8UC3", RGB[..., ::-1], RGB),
        ("rgba8", np.dstack([RGB, ALPHA]), RGB),
        ("bgra8", np.dstack([RGB[..., ::-1], ALPHA]), RGB),
        ("mono8", GREY, np.dstack([GREY] * 3)),
        ("mono16", GREY.astype("<u2") * 256, np.dstack([GREY] * 3)),
        ("mono16", (GREY.astype("<u2") * 256).astype(">u2"), np.dstack([GREY] * 3)),
    ],
)
def test_raw_images_of_every_order_of_bytes(encoding, values, shown, padding):
    message = MAKE.image(START, np.ascontiguousarray(values), encoding, padding=padding)
    assert picture_size(message) == (8, 6)
    np.testing.assert_array_equal(picture(message), shown)


@pytest.mark.parametrize(
    ("pattern", "first_row", "second_row"),
    [("rggb", "rg", "gb"), ("bggr", "bg", "gr"), ("gbrg", "gb", "rg"), ("grbg", "gr", "bg")],
)
@pytest.mark.parametrize("bits", [8, 16])
def test_bayer_patterns_begin_with_the_colours_of_their_names(pattern, first_row, second_row, bits):
    """A picture of one colour stays that colour."""
    colour = dict(zip("rgb", (200, 120, 40), strict=True))
    cell = np.array([[colour[c] for c in first_row], [colour[c] for c in second_row]])
    values = np.tile(cell, (8, 8)).astype("u1") if bits == 8 else np.tile(cell * 256, (8, 8)).astype("<u2")
    shown = picture(MAKE.image(START, values, f"bayer_{pattern}{bits}"))
    np.testing.assert_array_equal(shown[4, 4], [200, 120, 40])


@pytest.mark.parametrize(("encoding", "order"), [("yuv422", "uyvy"), ("uyvy", "uyvy"), ("yuv422_yuy2", "yuyv")])
def test_yuv_has_two_pixels_of_one_colour(encoding, order):
    """Red of BT.601: Y 81, U 90, V 240."""
    values = dict(zip("yuv", (81, 90, 240), strict=True))
    cell = np.array([values[letter] for letter in order], np.uint8)
    shown = picture(MAKE.image(START, np.tile(cell, (4, 4)).reshape(4, 8, 2), encoding))
    np.testing.assert_allclose(shown, np.broadcast_to([255, 0, 0], (4, 8, 3)), atol=3)


def test_compressed_images_are_those_of_their_files():
    data = cv2.imencode(".png", RGB[..., ::-1])[1].tobytes()
    message = MAKE.compressed(START, data, "rgb8; png compressed bgr8")
    assert picture_size(message) == (8, 6)
    np.testing.assert_array_equal(picture(message), RGB)
    for damaged in (b"", data[:40], b"no image at all"):
        with pytest.raises(ValueError, match=r".+"):
            picture(MAKE.compressed(START, damaged))


@pytest.mark.parametrize("make", [MAKE, MAKE_ROS1], ids=["ros2", "ros1"])
@pytest.mark.parametrize(
    ("model", "count"), [("plumb_bob", 5), ("plumb_bob", 4), ("rational_polynomial", 8), ("equidistant", 4)]
)
def test_lenses_bend_rays_as_opencv_does(make, model, count):
    D = np.array(COEFFICIENTS[:count])
    intrinsics = camera_of_info(make.info(START, K, (320, 240), model, D), False, "here")
    assert intrinsics is not None
    np.testing.assert_allclose(intrinsics.camera.matrix(), K)
    rays = np.column_stack([RAYS, np.ones(len(RAYS))])[None]
    if model == "equidistant":
        expected, _ = cv2.fisheye.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), D)
    else:
        expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), D)
    np.testing.assert_allclose(intrinsics.distortion.distort(RAYS), expected.reshape(-1, 2), atol=1e-12)


def test_rectified_images_have_the_camera_p_and_no_lens():
    info = MAKE.info(START, K, (320, 240), D=COEFFICIENTS[:5])
    info.p[[0, 5]] = 250.0
    intrinsics = camera_of_info(info, True, "here")
    assert intrinsics is not None and intrinsics.camera.fx == 250.0 and intrinsics.distortion.is_identity


@pytest.mark.parametrize("form", ["<f4", ">f4", "<f8"])
def test_clouds_of_either_precision_and_order(form):
    xyz = np.random.default_rng(2).normal(size=(20, 3)).astype(form)
    xyz[3, 1] = np.nan
    found = cloud_points(MAKE.cloud(START, xyz))
    np.testing.assert_array_equal(found, np.delete(xyz, 3, axis=0).astype(float))


def motion(*angles: float) -> Motion:
    """Turns about z by degrees, at 0 s, 1 s, ..., each a metre further along x."""
    rows = [[n, n, 0, 0, *Rotation.from_euler("z", a, degrees=True).as_quat()] for n, a in enumerate(angles)]
    return Motion.of_rows(np.array(rows, float), len(rows) == 1, "here")


def test_a_motion_turns_evenly_along_the_shortest_arc():
    moving = motion(0.0, 170.0, -170.0)
    T = moving.at(np.array([0.25, 1.5, 2.0, -0.1, 2.1]), 1.0)
    angles = Rotation.from_matrix(T[:3, :3, :3]).as_euler("zyx", degrees=True)[:, 0]
    np.testing.assert_allclose(np.cos(np.radians(angles - [42.5, 180.0, -170.0])), 1.0, atol=1e-12)
    np.testing.assert_allclose(T[:3, 0, 3], [0.25, 1.5, 2.0])
    assert np.isnan(T[3:]).all()
    assert np.isnan(moving.at(np.array([0.5]), 0.9)).all() and np.isfinite(moving.at(np.array([1.0]), 0.9)).all()


def test_poses_that_are_lost_are_left_out_and_order_does_not_matter():
    rows = np.array([[2.0, 2, 0, 0, 0, 0, 0, 1], [0.0, 0, 0, 0, 0, 0, 0, 1], [1.0, 5, 0, 0, 0, 0, 0, 0]])
    np.testing.assert_allclose(Motion.of_rows(rows, False, "here").at(np.array([1.0]), 5.0)[0, 0, 3], 1.0)
    with pytest.raises(InputError, match="here: all poses are NaN"):
        Motion.of_rows(rows[2:], False, "here")


def test_ways_through_the_tree_go_up_and_down():
    tree = FrameTree(
        {("map", "odom"): motion(90.0), ("odom", "base"): motion(0.0, 10.0), ("base", "arm"): motion(30.0)}
    )
    assert tree.root("arm") == "map" and tree.moves
    at = np.array([1.0])
    there, back = tree.at("map", "arm", at, 2.0), tree.at("arm", "map", at, 2.0)
    assert there is not None and back is not None
    np.testing.assert_allclose(there[0] @ back[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(Rotation.from_matrix(there[0, :3, :3]).as_euler("zyx", degrees=True)[0], 130.0)
    assert tree.at("map", "elsewhere", at, 2.0) is None
    np.testing.assert_array_equal(FrameTree({}).at("a", "a", at, 1.0), np.eye(4)[None])
