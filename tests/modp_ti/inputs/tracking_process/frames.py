"""Frames of random contents, and their comparison."""

from __future__ import annotations

import numpy as np

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera


def random_frame(index: int, width: int = 50, height: int = 46, masked: bool = False, points: int = 5) -> TrackedFrame:
    rng = np.random.default_rng(index)
    return TrackedFrame(
        index=index,
        timestamp=0.1 * index,
        name=f"live_{index:06d}",
        image=rng.random((height, width, 3), dtype=np.float32),
        camera=PinholeCamera(60.0, 61.0, width / 2, height / 2, width, height),
        T_camera_world=np.vstack([rng.random((3, 4)), [[0, 0, 0, 1]]]),
        points=SparsePoints(rng.random((points, 3)), rng.random((points, 2)), np.arange(points) + index),
        mask=rng.random((height, width)) > 0.5 if masked else None,
        held_out=index % 2 == 0,
        arrived=1000.0 + index,
    )


def assert_same(one: TrackedFrame, other: TrackedFrame) -> None:
    """Every byte of two frames is the same, except for the time of arrival."""
    for name in ("index", "timestamp", "name", "camera", "held_out"):
        assert getattr(one, name) == getattr(other, name), name
    for name in ("image", "T_camera_world", "rgba", "mask", "vignette"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
    for name in ("xyz", "pixels", "ids"):
        np.testing.assert_array_equal(getattr(one.points, name), getattr(other.points, name), name)
    for a, b in zip(one.pyramid, other.pyramid, strict=True):
        assert a.camera == b.camera
        np.testing.assert_array_equal(a.rgba, b.rgba)
