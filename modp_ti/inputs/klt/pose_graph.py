"""Pose graph over similarities, which distributes the drift of a loop, that of scale included, over its keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3

__all__ = ["Link", "closed_loop", "solver_is_there"]

STEPS = 50
# Uncertainties of a link in rotation [radians], place (relative to the scene's depth) and scale. Only their ratios
# matter.
SIGMA = 0.01


@dataclass(frozen=True)
class Link:
    """A measured relation of two keyframes.

    Attributes:
        a: Index of the one keyframe.
        b: Index of the other.
        T_a_b: (4, 4) similarity from the camera frame of b, in the scale around it, to that of a.
    """

    a: int
    b: int
    T_a_b: NDArray[np.float64]


def solver_is_there() -> bool:
    """Whether gtsam, which has no wheel for some platforms, is installed."""
    try:
        import gtsam  # noqa: F401
    except ImportError:
        return False
    return True


def closed_loop(
    poses: Sequence[NDArray[np.float64]], near: Sequence[tuple[int, int]], loops: Sequence[Link], depth: float
) -> list[NDArray[np.float64]]:
    """Find the similarities by which keyframes move so that loops close.

    Args:
        poses: T_camera_world (4, 4) of the keyframes. The first one stays.
        near: Pairs of keyframes whose relation shall stay as it is.
        loops: Relations that recognised places tell.
        depth: Typical depth of the scene.

    Returns:
        S_after_before (4, 4) of the world around each keyframe.
    """
    import gtsam

    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    cameras = [inverse_se3(T) for T in poses]

    def similarity(matrix: NDArray[np.float64]) -> gtsam.Similarity3:
        s = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        return gtsam.Similarity3(matrix[:3, :3] / s, matrix[:3, 3] / (s * depth), s)  # acts as s (R x + t)

    noise = gtsam.noiseModel.Isotropic.Sigma(7, SIGMA)
    for i, camera in enumerate(cameras):
        start.insert(i, similarity(camera))
    graph.add(gtsam.PriorFactorSimilarity3(0, similarity(cameras[0]), gtsam.noiseModel.Isotropic.Sigma(7, 1e-6)))
    for a, b in near:
        graph.add(gtsam.BetweenFactorSimilarity3(a, b, similarity(poses[a] @ cameras[b]), noise))
    for link in loops:
        graph.add(gtsam.BetweenFactorSimilarity3(link.a, link.b, similarity(link.T_a_b), noise))
    options = gtsam.LevenbergMarquardtParams()
    options.setMaxIterations(STEPS)
    result = gtsam.LevenbergMarquardtOptimizer(graph, start, options).optimize()
    moves = []
    for i, T in enumerate(poses):
        found = result.atSimilarity3(i)
        after, s = np.eye(4), float(found.scale())
        after[:3, :3] = s * found.rotation().matrix()
        after[:3, 3] = s * depth * np.asarray(found.translation())
        moves.append(after @ T)
    return moves
