"""The similarity from a tracker's world to that of a map, from frames of the tracker that were located in the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera, pixel_metric
from fields.geometry.se3 import exp_se3, inverse_se3, log_se3, motion_around, moved_pose, scale_of

# Fewest tracked points with a depth in the map that give a frame its scale.
LEAST_POINTS = 10
# Fewest frames that must agree on the similarity.
AGREEING = 3
# Largest image motion between two poses that agree, relative to the diagonal.
AGREE = 0.01
# Standard deviation of the logarithm of the scale by the depths of points.
DEPTH_DEVIATION = 0.05
# Gauss-Newton: number of steps, and differences of the derivatives: six of a pose [px] and that of the log scale.
STEPS = 10
DIFFERENCE = [1e-3] * 6 + [1e-6]


@dataclass(frozen=True)
class PlacedFrame:
    """A frame of a tracker that was located in a map.

    Attributes:
        index: Index of the frame.
        camera: Its camera.
        T_camera_map: Pose (4, 4) in the map.
        T_camera_tracker: Pose (4, 4) from the tracker.
        ids: Ids (N,) of its tracked points whose depth in the map is known.
        depth: Depths (N,) of these points in the map.
        xyz: Their positions (N, 3) in the tracker's world.
    """

    index: int
    camera: PinholeCamera
    T_camera_map: NDArray[np.float64]
    T_camera_tracker: NDArray[np.float64]
    ids: NDArray[np.int64]
    depth: NDArray[np.float64]
    xyz: NDArray[np.float64]

    def log_scales(self) -> NDArray[np.float64]:
        """Return the logarithms (M,) of the scale from the tracker's world to the map by each point in front."""
        T = self.T_camera_tracker
        tracked = self.xyz @ T[2, :3] + T[2, 3]
        ahead = tracked > 0
        return np.log(self.depth[ahead] / tracked[ahead])


@dataclass(frozen=True)
class WorldAlignment:
    """A similarity, and how well located frames agree on it.

    Attributes:
        S_map_tracker: Similarity (4, 4) from the tracker's world to that of the map.
        scale: Its scale.
        placed: Number of located frames.
        agreeing: Number of those that agree.
        residual: Root mean square of the image motion between the poses of these in the map and by the tracker [px].
    """

    S_map_tracker: NDArray[np.float64]
    scale: float
    placed: int
    agreeing: int
    residual: float


def image_motion(camera: PinholeCamera, depth: float, T_a: NDArray[np.float64], T_b: NDArray[np.float64]) -> float:
    """Return the image motion [px] between two poses (4, 4) of a camera, for a scene at a median depth."""
    xi = log_se3(T_b @ inverse_se3(T_a))
    return float(np.linalg.norm(np.linalg.solve(pixel_metric(camera, depth), xi)))


def world_alignment(frames: Sequence[PlacedFrame]) -> WorldAlignment | None:
    """Estimate the similarity on which most located frames agree.

    Each frame gives one alone: its two poses, and the median ratio of the depths of its points. The one that most
    frames agree with is chosen. These frames then estimate it together, by the image motion between their two poses.

    Returns:
        The alignment; None if fewer than three frames, or not more than half of them, agree.
    """
    known = [frame for frame in frames if len(frame.log_scales()) >= LEAST_POINTS]
    log_scales = [float(np.median(frame.log_scales())) for frame in known]
    best: list[int] = []
    for frame, log_scale in zip(known, log_scales, strict=True):
        S = motion_around(frame.T_camera_tracker, frame.T_camera_map, float(np.exp(log_scale)))
        agreeing = [i for i, other in enumerate(known) if np.linalg.norm(_motion(S, other)) <= _limit(other)]
        if len(agreeing) > len(best):
            best = agreeing
    if len(best) < AGREEING or 2 * len(best) <= len(known):
        return None
    chosen = [known[i] for i in best]
    S = _joint(chosen, float(np.median([log_scales[i] for i in best])))
    residual = float(np.sqrt(np.mean([np.linalg.norm(_motion(S, frame)) ** 2 for frame in chosen])))
    return WorldAlignment(S, float(scale_of(S)), len(frames), len(chosen), residual)


def _joint(frames: Sequence[PlacedFrame], log_scale: float) -> NDArray[np.float64]:
    """The similarity that fits the poses of the frames best.

    Depths of a map are too small by some percent where Gaussians float before surfaces, so that their scale counts only
    as far as the cameras are too close to each other to tell it.
    """
    around, scale = frames[len(frames) // 2], float(np.exp(log_scale))
    start = motion_around(around.T_camera_tracker, around.T_camera_map, scale)

    def similarity(x: NDArray[np.float64]) -> NDArray[np.float64]:
        """The start, changed in the camera of one frame: a motion in pixels, and the logarithm of a scale."""
        T = exp_se3(_metric(around) @ x[:6]) @ around.T_camera_map
        return motion_around(around.T_camera_map, T, float(np.exp(x[6]))) @ start

    def errors(x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Image motions [px] and the error of the scale, in standard deviations."""
        return np.concatenate([*(_motion(similarity(x), frame) for frame in frames), [x[6] / DEPTH_DEVIATION]])

    x = np.zeros(7)
    for _ in range(STEPS):
        now = errors(x)
        J = np.stack(
            [(errors(x + step) - errors(x - step)) / (2.0 * step.sum()) for step in np.diag(DIFFERENCE)], axis=1
        )
        weight = 1.0 / np.sqrt(1.0 + now**2)  # of a loss that is linear beyond a pixel
        x = x - np.linalg.solve(J.T @ (weight[:, None] * J), J.T @ (weight * now))
    return similarity(x)


def _metric(frame: PlacedFrame) -> NDArray[np.float64]:
    return pixel_metric(frame.camera, float(np.median(frame.depth)))


def _motion(S: NDArray[np.float64], frame: PlacedFrame) -> NDArray[np.float64]:
    """Image motion (6,) [px] from a frame's pose in the map to its pose by the tracker."""
    xi = log_se3(moved_pose(S, frame.T_camera_tracker) @ inverse_se3(frame.T_camera_map))
    return np.asarray(np.linalg.solve(_metric(frame), xi), dtype=np.float64)


def _limit(frame: PlacedFrame) -> float:
    return AGREE * float(np.hypot(frame.camera.width, frame.camera.height))
