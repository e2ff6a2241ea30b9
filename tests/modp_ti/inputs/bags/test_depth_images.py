"""Depth images of a bag give the images beside them points on the surface that both show."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest

from modp_ti.inputs.bags.messages import depth_metres
from tests.opening import off_pixels
from tests.samples.bags import START, STEP, Messages, recording, write_bag
from tests.samples.filmed import plane_depth

MAKE = Messages()
METRES = np.array([[0.0, 0.5, 1.25], [2.0, 4.0, 0.0]], np.float32)
ENCODED = {
    "16UC1": MAKE.image(START, (1000 * METRES).astype("<u2"), "16UC1"),
    "16UC1, big-endian": MAKE.image(START, (1000 * METRES).astype(">u2"), "16UC1", padding=2),
    "32FC1": MAKE.image(START, METRES.astype("<f4"), "32FC1"),
}
# A sensor 3 cm beside the camera, turned by a tenth, and half as wide.
T_OPTICAL_SENSOR = np.array([[np.cos(0.1), 0, np.sin(0.1), 0.03], [0, 1, 0, 0], [-np.sin(0.1), 0, np.cos(0.1), 0]])
T_OPTICAL_SENSOR = np.vstack([T_OPTICAL_SENSOR, [0, 0, 0, 1]])
K_SENSOR = np.array([[140.0, 0, 80.0], [0, 140.0, 60.0], [0, 0, 1]])


def compressed(values: np.ndarray, form: str, parameters: tuple[float, float] = (0.0, 0.0)):
    data = struct.pack("<iff", 0, *parameters) + cv2.imencode(".png", values)[1].tobytes()
    return MAKE.compressed(START, data, f"{form}; compressedDepth png")


def millimetres(T_world_camera: np.ndarray, K: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return np.round(1000 * plane_depth(T_world_camera, K, size)).astype("<u2")


def with_depths(views, delay: int = 0):
    messages = recording(views)
    for n, view in enumerate(views):
        time = START + n * STEP
        values = millimetres(view.T_world_camera, view.K, view.size)
        messages.append(("/depth/image", time, MAKE.image(time + delay, values, "16UC1")))
    return messages


def assert_on_the_plane(tracker, count: int) -> None:
    assert len(tracker.frames) == count
    ids = np.concatenate([frame.points.ids for frame in tracker.frames])
    assert len(np.unique(ids)) == len(ids)
    for frame in tracker.frames:
        assert 200 < len(frame.points) <= 400 and off_pixels(frame).max() < 1e-6
        assert np.abs(frame.points.xyz[:, 2]).max() < 1e-3  # depths of whole millimetres


@pytest.mark.parametrize("encoding", ENCODED)
def test_depths_are_those_of_the_image(encoding):
    np.testing.assert_allclose(depth_metres(ENCODED[encoding]), METRES, rtol=1e-6)


def test_compressed_depths_are_millimetres_or_inverse():
    np.testing.assert_allclose(depth_metres(compressed((1000 * METRES).astype(np.uint16), "16UC1")), METRES, rtol=1e-6)
    scale, offset = 10000.0, -1.0
    inverse = np.where(METRES > 0, scale / np.maximum(METRES, 1e-9) + offset, 0).round().astype(np.uint16)
    np.testing.assert_allclose(depth_metres(compressed(inverse, "32FC1", (scale, offset))), METRES, rtol=1e-3)


@pytest.mark.parametrize("data", [b"", b"\0" * 12, b"\0" * 12 + b"\x89PNG\r\n\x1a\n" + b"\0" * 40])
def test_damaged_depth_images_are_told(data):
    with pytest.raises(ValueError):
        depth_metres(MAKE.compressed(START, data, "16UC1; compressedDepth png"))


def test_depths_of_the_cameras_own_frame_are_its_points(views, tmp_path, opened):
    tracker = opened(write_bag(tmp_path / "room", "mcap", with_depths(views)), "bag", {"scale": 1})
    assert_on_the_plane(tracker, len(views))
    assert "points of the depth images of /depth/image for 7 of 7 images" in " ".join(tracker.notes)


def test_depths_of_a_sensor_beside_the_camera_are_moved_to_it(views, tmp_path, opened):
    messages, size = recording(views), (160, 120)
    mount = MAKE.tree(MAKE.transform(0, "optical", "depth_optical", T_OPTICAL_SENSOR))
    messages.append(("/tf_static", START - STEP, mount))
    for n, view in enumerate(views):
        time = START + n * STEP
        values = millimetres(view.T_world_camera @ T_OPTICAL_SENSOR, K_SENSOR, size)
        messages.append(("/depth/image", time, MAKE.image(time, values, "16UC1", "depth_optical")))
        messages.append(("/depth/camera_info", time, MAKE.info(time, K_SENSOR, size, frame="depth_optical")))
    assert_on_the_plane(opened(write_bag(tmp_path / "room", "mcap", messages), "bag", {"scale": 1}), len(views))
