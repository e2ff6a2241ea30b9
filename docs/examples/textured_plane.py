"""Made-up input for the examples: a textured plane seen by a moving camera, drawn with NumPy.

In your own program, a camera and a tracker take the place of this module.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

WIDTH, HEIGHT = 96, 72
FOCAL = 90.0
INTRINSICS = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)  # fx, fy, cx, cy [px]; the centre of the first pixel is (0.5, 0.5)

NORMAL, OFFSET = np.array([0.2, 0.1, -1.0]), -4.0  # the plane is NORMAL @ x == OFFSET, about 4 units ahead


@dataclass(frozen=True)
class Observation:
    """What a tracker knows about one frame.

    image: (H, W, 3) uint8 RGB. T_camera_world: (4, 4), world to camera, OpenCV axes. xyz: (N, 3) points in the world.
    pixels: (N, 2), where this image shows them, as (x, y). ids: (N,), the same number for the same point in all frames.
    """

    image: np.ndarray
    T_camera_world: np.ndarray
    xyz: np.ndarray
    pixels: np.ndarray
    ids: np.ndarray


def observe(count: int) -> Iterator[Observation]:
    """Yield `count` frames of a camera that moves to the right past the plane."""
    x, y = np.random.default_rng(0).uniform([-4.0, -2.5], [4.0, 2.5], (600, 2)).T
    landmarks = np.stack([x, y, (OFFSET - NORMAL[0] * x - NORMAL[1] * y) / NORMAL[2]], axis=1)
    for i in range(count):
        T = pose(i - count / 2)
        points_camera = landmarks @ T[:3, :3].T + T[:3, 3]
        pixels = FOCAL * points_camera[:, :2] / points_camera[:, 2:] + (WIDTH / 2, HEIGHT / 2)
        ids = np.flatnonzero(((pixels > 1) & (pixels < (WIDTH - 1, HEIGHT - 1))).all(axis=1))
        yield Observation(draw(T), T, landmarks[ids], pixels[ids], ids)


def pose(step: float) -> np.ndarray:
    """T_camera_world (4, 4) of the camera, `step` steps to the right of the middle of its path."""
    angle = 0.02 * step
    T = np.eye(4)
    T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T[:3, 3] = T[:3, :3] @ [-0.16 * step, 0.02 * step, 0.0]
    return T


def draw(T_camera_world: np.ndarray) -> np.ndarray:
    """Return the image (H, W, 3) uint8 that the camera takes at this pose."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays_camera = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], axis=-1)
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    rays, centre = rays_camera @ R, -R.T @ t
    depth = (OFFSET - NORMAL @ centre) / (rays @ NORMAL)
    x, y, _ = np.moveaxis(centre + depth[..., None] * rays, -1, 0)
    waves = [np.sin(3 * x + 1) * np.cos(2 * y), np.sin(2 * x - 3 * y), np.cos(4 * x) * np.sin(3 * y + 2)]
    return np.round(255 * (0.5 + 0.4 * np.stack(waves, axis=-1))).astype(np.uint8)


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio [dB] of a float image in [0, 1] against a uint8 one."""
    return float(-10 * np.log10(np.mean((np.clip(image, 0, 1) - truth / 255) ** 2)))
