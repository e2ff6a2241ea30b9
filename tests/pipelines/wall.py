"""A picture on a slanted plane, seen by a camera that moves sideways, walks along it, or has someone walk past."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3
from tests.spread import disturbed

CAMERA = PinholeCamera(60.0, 60.0, 32.0, 24.0, 64, 48)
NORMAL, OFFSET = np.array([0.2, 0.1, -1.0]), -4.0  # the plane n . x = d


def pose(i: int) -> np.ndarray:
    return exp_se3([0.12 * (3 - i), 0.03 * i, 0.0, 0.01 * i, 0.02 * (i - 3), 0.0])


def texture(xyz: np.ndarray) -> np.ndarray:
    """Smooth colours (N, 3) in [0, 1] over the plane."""
    x, y = xyz[:, 0], xyz[:, 1]
    waves = [np.sin(3 * x + 1) * np.cos(2 * y), np.sin(2 * x - 3 * y), np.cos(4 * x) * np.sin(3 * y + 2)]
    return 0.5 + 0.4 * np.stack(waves, axis=1)


def on_the_plane(pixels: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Where the rays of pixels (N, 2) meet the plane, in the world."""
    rays = CAMERA.unproject(pixels, np.ones(len(pixels))) @ T[:3, :3]
    centre = -T[:3, :3].T @ T[:3, 3]
    return centre + rays * ((OFFSET - NORMAL @ centre) / (rays @ NORMAL))[:, None]


def frame(i: int, held_out: bool = False, scale: float = 1.0) -> TrackedFrame:
    T = pose(i)
    x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    image = texture(on_the_plane(np.stack([x.ravel(), y.ravel()], axis=1), T)).reshape(48, 64, 3)
    pixels = np.random.default_rng(i).uniform([1, 1], [63, 47], (120, 2))
    xyz = disturbed(scale * on_the_plane(pixels, T))
    points = SparsePoints(xyz, pixels, np.arange(120) + 1000 * i)
    T = disturbed(T)
    T[:3, 3] *= scale
    return TrackedFrame(i, i / 30, f"{i}", disturbed(image.astype(np.float32)), CAMERA, T, points, held_out=held_out)


# Along the wall, so that the camera keeps its distance.
ALONG = np.array([1.0, 0.0, 0.2])


def walked_along(index: int, step: float) -> TrackedFrame:
    """A frame of the camera `step` steps from where it began."""
    T = np.eye(4)
    T[:3, 3] = -0.6 * step * ALONG
    x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    image = texture(on_the_plane(np.stack([x.ravel(), y.ravel()], axis=1), T)).reshape(48, 64, 3)
    pixels = np.random.default_rng(index).uniform([1, 1], [63, 47], (120, 2))
    points = SparsePoints(disturbed(on_the_plane(pixels, T)), pixels, np.arange(120) + 1000 * index)
    return TrackedFrame(index, index / 30, f"{index}", disturbed(image.astype(np.float32)), CAMERA, T, points)


FRAMES = 24
WALKED = {"optimise": {"steps": 10}, "densify": {"warm_up": 2}}


def still(i: int) -> TrackedFrame:
    """A frame of a camera that goes to the right and back, as far as that of `wall`."""
    there = frame(round(3 - 3 * np.cos(2 * np.pi * i / FRAMES)))
    return replace(there, index=i, timestamp=i / 30, name=f"{i}")


def walker(i: int) -> np.ndarray:
    """Where a frame (48, 64) shows what walks: 14 pixels wide, 30 high, four pixels further in each frame."""
    shown = np.zeros((48, 64), dtype=bool)
    left = 4 * i - 14
    shown[12:42, max(left, 0) : max(left + 14, 0)] = True
    return shown


def walked(i: int) -> TrackedFrame:
    seen = still(i)
    image = seen.image.copy()
    image[walker(i)] = (0.95, 0.9, 0.1)
    return TrackedFrame(i, i / 30, f"{i}", image, seen.camera, seen.T_camera_world, seen.points)
