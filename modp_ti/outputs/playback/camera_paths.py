"""Camera paths through a finished map, each as T_camera_world (M, 4, 4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import camera_centres, inverse_poses

# Weight that pulls the focus to the points at the scene's depth on the optical axes. It determines the focus if the
# axes are parallel.
HELD = 0.1
# The orbit is a full circle if the largest gap between the keyframes' directions is below LARGEST_GAP. Otherwise it
# swings back and forth over these directions, without the fraction ENDS at both ends, where few keyframes saw the
# scene, but by at least SWING to either side.
LARGEST_GAP = np.radians(120.0)
ENDS = 0.1
SWING = np.radians(10.0)


def smoothed(poses: NDArray[np.float64], count: int, deviation: float) -> NDArray[np.float64]:
    """Return `count` poses (count, 4, 4) along a recorded path, each a Gaussian-weighted mean of the poses around it.

    The ends of the path are pulled inwards by about `deviation`.

    Args:
        poses: (N, 4, 4) recorded T_camera_world.
        count: Number of poses to return.
        deviation: Standard deviation of the weights [frames].
    """
    n = len(poses)
    at = np.linspace(0.0, n - 1.0, count)
    # Relative to the nearest frame, so that a narrow Gaussian between two frames does not underflow.
    square = (at[:, None] - np.arange(n)) ** 2
    weights = np.exp(-0.5 * (square - square.min(axis=1, keepdims=True)) / max(deviation, 1e-3) ** 2)
    weights /= weights.sum(axis=1, keepdims=True)
    rotations = poses[:, :3, :3].transpose(0, 2, 1)  # camera to world
    centres = camera_centres(poses)
    # Chordal mean: the rotation nearest to the weighted sum of the rotation matrices.
    U, _, Vt = np.linalg.svd((weights @ rotations.reshape(n, 9)).reshape(count, 3, 3))
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    T_world_camera = np.tile(np.eye(4), (count, 1, 1))
    T_world_camera[:, :3, :3], T_world_camera[:, :3, 3] = U @ Vt, weights @ centres
    return inverse_poses(T_world_camera)


def orbit(poses: NDArray[np.float64], depth: float, count: int) -> NDArray[np.float64]:
    """Return poses (count, 4, 4) around the point that the keyframes look at, at their median distance and height.

    The camera looks inwards if the keyframes do (around an object), and outwards otherwise (inside a room). If the
    keyframes do not surround the focus, the path swings over the directions that they cover.

    Args:
        poses: (N, 4, 4) T_camera_world of the keyframes.
        depth: The scene's depth [scene units].
        count: Number of poses.
    """
    centres, forward = camera_centres(poses), poses[:, 2, :3]
    up = -poses[:, 1, :3].mean(axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-6 else -poses[0, 1, :3]
    focus = _focus(centres, forward, depth)
    away = centres - focus
    height = away @ up
    flat = away - height[:, None] * up
    distance = np.linalg.norm(flat, axis=1)
    radius = max(float(np.median(distance)), 0.05 * depth)
    e1 = _unit_across(flat.mean(axis=0), up)
    e2 = np.cross(up, e1)
    inwards = np.median(np.einsum("ij,ij->i", forward, -flat)) >= 0
    angles = _angles(np.arctan2(flat @ e2, flat @ e1), count)
    around = radius * (np.cos(angles)[:, None] * e1 + np.sin(angles)[:, None] * e2)
    eyes = focus + np.median(height) * up + around
    return np.stack([looking_at(eye, focus if inwards else 2 * eye - focus, up) for eye in eyes])


def looking_at(eye: NDArray[np.float64], target: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return T_camera_world (4, 4) of an upright camera at `eye` that looks at `target`."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = _unit_across(np.cross(z, up), z)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z])
    T[:3, 3] = -T[:3, :3] @ eye
    return T


def upright(T_camera_world: NDArray[np.float64], down: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return T_camera_world (4, 4) turned such that the horizon is level and in the middle, given down (3,)."""
    eye = camera_centres(T_camera_world[None])[0]
    ahead = T_camera_world[2, :3] - 1e-3 * T_camera_world[1, :3]  # of a camera that looks down, its picture's top
    return looking_at(eye, eye + ahead - (ahead @ down) * down, -down)


def _focus(centres: NDArray[np.float64], forward: NDArray[np.float64], depth: float) -> NDArray[np.float64]:
    """Return the point (3,) nearest to all optical axes, regularised towards the points on them at `depth`."""
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    A = across.sum(axis=0) + HELD * len(centres) * np.eye(3)
    b = (across @ centres[:, :, None]).sum(axis=0)[:, 0] + HELD * (centres + depth * forward).sum(axis=0)
    return np.linalg.solve(A, b)


def _angles(taken_from: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return the angles (count,) of the orbit's poses, given the keyframes' angles (N,) in [-pi, pi]."""
    ordered = np.sort(taken_from)
    gaps = np.diff(np.append(ordered, ordered[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    turn = 2 * np.pi * np.arange(count) / count
    if gaps[widest] < LARGEST_GAP:
        return turn
    ordered[: widest + 1] += 2 * np.pi  # continue after the gap
    first, last = np.quantile(ordered, [ENDS, 1 - ENDS])
    return (first + last) / 2 + max((last - first) / 2, SWING) * np.sin(turn)


def _unit_across(v: NDArray[np.float64], axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit vector (3,) along the part of `v` orthogonal to `axis`; any orthogonal one if it is 0."""
    v = v - (v @ axis) * axis
    if np.linalg.norm(v) < 1e-9:
        least: NDArray[np.float64] = np.eye(3)[np.argmin(np.abs(axis))]
        v = np.cross(axis, least)
    return v / np.linalg.norm(v)
