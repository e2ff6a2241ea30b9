"""The cost of a wrong depth: the distance in pixels by which other views see the point misplaced."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from fields.map.keyframe import Keyframe

__all__ = ["misplacement"]

MAX_VIEWS = 16
# Points nearer to a camera than this are not seen by it [its median depths].
NEAR = 0.01


def misplacement(
    view: Keyframe,
    neighbours: Sequence[Keyframe],
    pixels: NDArray[np.float64],
    depth: NDArray[np.float64],
    deviation: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Distance by which a depth that is wrong by its deviation moves a pixel's point in other views.

    Args:
        view: The view of the pixels.
        neighbours: The other views, of which at most `MAX_VIEWS` are used, spread evenly over the list.
        pixels: Pixels (N, 2) as (x, y).
        depth: Depth (N,) of the pixels.
        deviation: Standard deviation (N,) of log depth.

    Returns:
        Root mean square (N,) over the views that see the point [px]; inf where none does.
    """
    T_world_camera = inverse_se3(view.T_camera_world)
    square, count = np.zeros(len(depth)), np.zeros(len(depth))
    places = [
        view.camera.unproject(pixels, z) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        for z in (depth, depth * np.exp(deviation))
    ]
    some = np.unique(np.linspace(0, len(neighbours) - 1, min(MAX_VIEWS, len(neighbours))).round().astype(int))
    for other in (neighbours[j] for j in some):
        a, b = (xyz @ other.T_camera_world[:3, :3].T + other.T_camera_world[:3, 3] for xyz in places)
        nearest = NEAR * other.median_depth
        front = np.flatnonzero((a[:, 2] > nearest) & (b[:, 2] > nearest))
        a, b = other.camera.project(a[front]), other.camera.project(b[front])
        seen = other.camera.contains(a)
        square[front[seen]] += ((a - b)[seen] ** 2).sum(axis=1)
        count[front[seen]] += 1
    return np.where(count > 0, np.sqrt(square / np.maximum(count, 1)), np.inf)
