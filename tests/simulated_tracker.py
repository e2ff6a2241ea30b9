"""A simulated tracker of the room: its pose errors, and its drift around a loop until it corrects its poses."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.se3 import inverse_se3, moved_points, moved_pose
from tests.room import look_at

SCENE_DEPTH = 2.5  # typical distance of surfaces from the camera [m]
LOOP_CLOSES = 0.9  # fraction of the loop's frames after which the camera sees its first view again


def smooth_walks(frames: int, count: int, smooth: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return standard-normal values (frames, count). Each column is correlated over `smooth` frames, 0 for none."""
    distance = np.arange(frames)[:, None] - np.arange(frames)
    kernel = np.exp(-0.5 * (distance / max(smooth, 1e-3)) ** 2)
    return kernel / np.linalg.norm(kernel, axis=1, keepdims=True) @ rng.standard_normal((frames, count))


def noisy_poses(
    T_camera_world: list[NDArray[np.float64]], translation: float, rotation: float, smooth: float, seed: int = 0
) -> list[NDArray[np.float64]]:
    """Return poses (4, 4) with random errors.

    Args:
        T_camera_world: True poses (4, 4).
        translation: Standard deviation of the translation per axis, as a fraction of the scene's depth.
        rotation: Standard deviation of the rotation per axis [degrees].
        smooth: Number of frames over which the errors are correlated, 0 for independent errors.
        seed: Seed of the errors.
    """
    walks = smooth_walks(len(T_camera_world), 6, smooth, np.random.default_rng(seed))
    poses = []
    for T, walk in zip(T_camera_world, walks, strict=True):
        error = np.eye(4)
        error[:3, :3] = cv2.Rodrigues(np.radians(rotation) * walk[3:])[0]
        error[:3, 3] = translation * SCENE_DEPTH * walk[:3]
        poses.append(error @ T)
    return poses


def tracked(frames: list[TrackedFrame], poses: list[NDArray[np.float64]]) -> list[TrackedFrame]:
    """Return the frames with other poses (4, 4). Each point lies where the first frame that sees it puts it."""
    xyz: dict[int, NDArray[np.float64]] = {}
    found = []
    for frame, T in zip(frames, poses, strict=True):
        there = moved_points(inverse_se3(T) @ frame.T_camera_world, frame.points.xyz)
        places = [xyz.setdefault(int(i), place) for i, place in zip(frame.points.ids, there, strict=True)]
        points = SparsePoints(np.array(places).reshape(-1, 3), frame.points.pixels, frame.points.ids)
        found.append(replace(frame, T_camera_world=T, points=points))
    return found


def loop(frames: int) -> list[NDArray[np.float64]]:
    """Return T_camera_world (4, 4) on a circle, looking outwards, for one turn and on over the first views."""
    poses = []
    for share in np.linspace(0, 1, frames):
        angle = np.radians(60) + 2 * np.pi * share / LOOP_CLOSES
        outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
        eye = np.array([-0.1, -0.5, 1.42]) + 0.5 * outwards
        poses.append(look_at(eye, eye + outwards + [0.0, 0.0, -0.22]))
    return poses


def drifting(frames: list[TrackedFrame], drift: float) -> list[TrackedFrame | PoseCorrection]:
    """Return the frames of a loop as a tracker delivers them that corrects its drift when it closes the loop.

    Args:
        frames: The frames of `loop`, with the poses and points after the correction.
        drift: What the world's shift [scene depths], turn [radians] and log scale have become when the loop closes.
    """
    events: list[TrackedFrame | PoseCorrection] = []
    xyz: dict[int, NDArray[np.float64]] = {}
    closed = int(np.ceil(LOOP_CLOSES * (len(frames) - 1)))
    for i, frame in enumerate(frames):
        if i == closed:
            poses = np.stack([before.T_camera_world for before in frames[:i]])
            events.append(PoseCorrection(np.arange(i), poses, np.array(list(xyz)), np.array(list(xyz.values()))))
        points = frame.points
        xyz.update(zip(points.ids.tolist(), points.xyz, strict=True))
        if i < closed:
            S = drifted_world(drift * i / closed, frames[0].T_camera_world)
            points = replace(points, xyz=moved_points(S, points.xyz))
            frame = replace(frame, T_camera_world=moved_pose(S, frame.T_camera_world), points=points)
        events.append(frame)
    return events


def drifted_world(amount: float, T_camera_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return S (4, 4), which turns and scales the world about the centre of a camera (4, 4) and shifts it."""
    centre = inverse_se3(T_camera_world)[:3, 3]
    S = np.eye(4)
    S[:3, :3] = np.exp(amount) * cv2.Rodrigues(amount * np.array([0.48, -0.36, 0.8]))[0]
    S[:3, 3] = centre - S[:3, :3] @ centre + amount * SCENE_DEPTH * np.array([0.6, 0.64, 0.48])
    return S
