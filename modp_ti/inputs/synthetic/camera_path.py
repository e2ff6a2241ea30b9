"""The camera's way through the demo room: a smooth handheld walk with a look around."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["LOOP_CLOSES", "camera_path", "look_at"]

# Eye and target at equal steps of time [m]. The eye always moves sideways while it turns: rotation alone
# gives no parallax.
STATIONS = np.array(
    [
        [[1.10, -1.10, 1.42], [-1.60, 1.30, 1.00]],
        [[0.75, -1.00, 1.46], [-1.00, 1.60, 1.00]],
        [[0.35, -0.95, 1.50], [-0.40, 1.70, 0.95]],
        [[-0.05, -1.00, 1.45], [0.20, 1.75, 0.95]],
        [[-0.45, -1.00, 1.40], [0.90, 1.60, 0.95]],
        [[-0.80, -0.90, 1.42], [1.60, 1.20, 0.95]],
        [[-1.00, -0.70, 1.48], [2.00, 0.70, 1.00]],
    ]
)

# The loop: around a circle, looking outwards, once and on over the views that it began with.
LOOP_CENTRE, LOOP_RADIUS, LOOP_TILT = np.array([-0.1, -0.5, 1.42]), 0.5, -0.22  # [m], [m], rise a metre
LOOP_START = np.radians(60.0)
LOOP_CLOSES = 0.9  # share of the time after which it looks as at its beginning again

# Hand tremor: amplitude, cycles over the whole path and phase of each coordinate, for eye and target.
TREMOR = 0.012  # [m]
TREMOR_CYCLES = np.array([[[3.1, 4.3, 5.2], [2.7, 3.9, 6.1]], [[7.3, 6.4, 8.9], [8.1, 9.2, 7.7]]])
TREMOR_PHASES = np.array([[[0.3, 1.9, 4.0], [2.2, 5.1, 0.8]], [[1.1, 3.3, 2.6], [4.7, 0.2, 3.8]]])


def look_at(eye: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """T_camera_world (4, 4) of an upright camera at `eye` that looks at `target` (z is up in the world)."""
    z = target - eye
    z = z / np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x)
    transform = np.eye(4)
    transform[:3, :3] = np.stack([x, np.cross(z, x), z])
    transform[:3, 3] = -transform[:3, :3] @ eye
    return transform


def camera_path(frames: int, loop: bool = False) -> list[NDArray[np.float64]]:
    """T_camera_world (4, 4) in metres of `frames` views at equal steps of time.

    loop: around the room instead; at the share LOOP_CLOSES of the time the camera is where it began.
    """
    return [look_at(*((_on_the_loop if loop else _on_the_way)(t) + _tremor(t))) for t in np.linspace(0.0, 1.0, frames)]


def _on_the_loop(t: float) -> NDArray[np.float64]:
    """Eye and target (2, 3) at time t in [0, 1]."""
    angle = LOOP_START + 2 * np.pi * t / LOOP_CLOSES
    way = np.array([np.cos(angle), np.sin(angle), 0.0])
    eye = LOOP_CENTRE + LOOP_RADIUS * way
    return np.stack([eye, eye + way + [0.0, 0.0, LOOP_TILT]])


def _on_the_way(t: float) -> NDArray[np.float64]:
    """Eye and target (2, 3) at time t in [0, 1]: a Catmull-Rom spline through the stations."""
    padded = np.concatenate([2 * STATIONS[:1] - STATIONS[1:2], STATIONS, 2 * STATIONS[-1:] - STATIONS[-2:-1]])
    position = t * (len(STATIONS) - 1)
    k = min(int(position), len(STATIONS) - 2)
    s = position - k
    a, b, c, d = padded[k : k + 4]
    return b + 0.5 * s * (c - a + s * (2 * a - 5 * b + 4 * c - d + s * (3 * (b - c) + d - a)))


def _tremor(t: float) -> NDArray[np.float64]:
    """What the hand adds to eye and target (2, 3) at time t in [0, 1]."""
    return TREMOR * np.sin(2 * np.pi * TREMOR_CYCLES * t + TREMOR_PHASES).sum(axis=0)
