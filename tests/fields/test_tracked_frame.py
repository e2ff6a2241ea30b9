from __future__ import annotations

import numpy as np
import pytest

from fields.camera import PinholeCamera
from fields.tracked_frame import SparsePoints, TrackedFrame

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
