"""A camera that walks along the wall of `tests.pipelines.wall`, out and home."""

from __future__ import annotations

import numpy as np

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from tests.pipelines.wall import CAMERA, on_the_plane, texture
from tests.spread import disturbed

# Along the wall, so that the camera keeps its distance.
ALONG = np.array([1.0, 0.0, 0.2])


def frame(index: int, step: float) -> TrackedFrame:
    """A frame of the camera `step` steps from where it began."""
    T = np.eye(4)
    T[:3, 3] = -0.6 * step * ALONG
    x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    image = texture(on_the_plane(np.stack([x.ravel(), y.ravel()], axis=1), T)).reshape(48, 64, 3)
    pixels = np.random.default_rng(index).uniform([1, 1], [63, 47], (120, 2))
    points = SparsePoints(disturbed(on_the_plane(pixels, T)), pixels, np.arange(120) + 1000 * index)
    return TrackedFrame(index, index / 30, f"{index}", disturbed(image.astype(np.float32)), CAMERA, T, points)
