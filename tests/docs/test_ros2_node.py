"""The example of a ROS 2 node: what it makes of messages is what the tracker server understands."""

from __future__ import annotations

import runpy
import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modp_ti.inputs.tracker_server import messages
from tests.samples.bags import START, Messages

NODE = runpy.run_path(str(Path(__file__).resolve().parents[2] / "docs" / "examples" / "ros2_node.py"))
K = np.array([[60.0, 0, 50.5], [0, 62.0, 36.5], [0, 0, 1]])
RGB = np.random.default_rng(1).integers(0, 255, (72, 100, 3)).astype(np.uint8)
POSE = np.eye(4)
POSE[:3, :3] = Rotation.from_euler("zyx", [40.0, 20.0, -30.0], degrees=True).as_matrix()
POSE[:3, 3] = (1.0, -2.0, 0.5)


def payload(message: bytes) -> bytes:
    magic, version, _, length, zero = struct.unpack("<4sHHII", message[:16])
    assert (magic, version, length, zero) == (b"MODP", 1, len(message) - 16, 0)
    return message[16:]


@pytest.mark.parametrize(
    ("encoding", "values", "kind"),
    [
        ("rgb8", RGB, messages.Encoding.RGB8),
        ("bgr8", RGB[..., ::-1], messages.Encoding.RGB8),
        ("mono8", RGB[..., 0], messages.Encoding.GREY8),
    ],
)
def test_images_and_cameras_arrive_as_they_were(encoding, values, kind):
    make = Messages()
    image, info = make.image(START, values, encoding, padding=5), make.info(START, K, (100, 72))
    first = messages.parse_hello(payload(NODE["hello"](image, info)))
    assert first.encoding is kind
    np.testing.assert_allclose(first.intrinsics.camera.matrix(), K)
    sent = messages.parse_frame(payload(NODE["frame"](7, image, None, info, None)), messages.Kind.FRAME)
    assert sent.number == 7 and sent.state is messages.State.LOST
    assert kind.channels is not None
    stored = np.frombuffer(sent.image, np.uint8).reshape(72, 100, kind.channels)
    np.testing.assert_array_equal(stored, RGB[..., : kind.channels])


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
@pytest.mark.parametrize("order", "<>")
def test_points_of_the_depths_lie_where_their_pixels_see_them(encoding, order):
    """The scene is the plane z = 3 of the camera, but for a part that is not known."""
    make = Messages()
    image, info = make.image(START, RGB, "rgb8"), make.info(START, K, (100, 72))
    values = np.full((72, 100), 3000, order + "u2") if encoding == "16UC1" else np.full((72, 100), 3.0, order + "f4")
    values[:, :40] = 0
    transform = make.transform(START, "odom", "optical", POSE).transform
    depth = make.image(START, values, encoding, padding=2)
    sent = messages.parse_frame(payload(NODE["frame"](2, image, depth, info, transform)), messages.Kind.FRAME)
    assert sent.state is messages.State.KNOWN and sent.timestamp == pytest.approx(START * 1e-9)
    np.testing.assert_allclose(sent.T_camera_world, np.linalg.inv(POSE), atol=1e-12)
    in_camera = sent.points.xyz @ sent.T_camera_world[:3, :3].T + sent.T_camera_world[:3, 3]
    np.testing.assert_allclose(in_camera[:, 2], 3.0)
    np.testing.assert_allclose((in_camera / 3.0) @ K[:2].T, sent.points.pixels, atol=1e-9)
    assert len(sent.points) == 6 and (sent.points.pixels[:, 0] > 40).all()
    assert len(set(sent.points.ids.tolist())) == 6


def test_the_node_needs_nothing_of_this_program():
    source = (Path(__file__).resolve().parents[2] / "docs" / "examples" / "ros2_node.py").read_text()
    assert "import modp_ti" not in source and "from modp_ti" not in source
