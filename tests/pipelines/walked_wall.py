"""The wall with something that walks past it while it is mapped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fields.frames.tracked_frame import TrackedFrame
from tests.pipelines import wall

FRAMES = 24
SETTINGS = {"optimise": {"steps": 10}, "densify": {"warm_up": 2}}


def still(i: int) -> TrackedFrame:
    """A frame of a camera that goes to the right and back, as far as that of `wall`."""
    there = wall.frame(round(3 - 3 * np.cos(2 * np.pi * i / FRAMES)))
    return replace(there, index=i, timestamp=i / 30, name=f"{i}")


def walker(i: int) -> np.ndarray:
    """Where a frame (48, 64) shows what walks: 14 pixels wide, 30 high, four pixels further in each frame."""
    shown = np.zeros((48, 64), dtype=bool)
    left = 4 * i - 14
    shown[12:42, max(left, 0) : max(left + 14, 0)] = True
    return shown


def walked(i: int) -> TrackedFrame:
    frame = still(i)
    image = frame.image.copy()
    image[walker(i)] = (0.95, 0.9, 0.1)
    return TrackedFrame(i, i / 30, f"{i}", image, frame.camera, frame.T_camera_world, frame.points)
