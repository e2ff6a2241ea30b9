"""Division of a finished map into regions of space, with the views that see each of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.map.blocks import Blocks, divide, extent_of, planes_of, seen
from pipelines.blocks.away import REACH
from pipelines.blocks.paging import SIDE

__all__ = ["Eye", "Region", "regions"]


@dataclass(frozen=True)
class Eye:
    """Where a view looks from.

    Attributes:
        camera: Its camera.
        T_camera_world: Its pose (4, 4).
    """

    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]

    def planes(self, far: float) -> NDArray[np.float64]:
        """Return the planes (6, 4) that bound what it sees up to the depth `far` [scene units]."""
        return planes_of(self.camera, self.T_camera_world, far)


@dataclass(frozen=True)
class Region:
    """A region of space.

    Attributes:
        own: Places (N,) of the Gaussians that lie in it, in increasing order.
        around: Places (M,) of the other Gaussians that its views see, in increasing order.
        views: Places (V,) of the views that see it, in increasing order.
        load: Number of views that it would fill: the sum over the views of its share in what each of them sees.
    """

    own: NDArray[np.int64]
    around: NDArray[np.int64]
    views: NDArray[np.int64]
    load: float


def regions(
    gaussians: Mapping[str, NDArray], eyes: Sequence[Eye], scene_depth: float, count: int, turn: int = 0
) -> list[Region]:
    """Divide a map into regions with about the same number of Gaussians.

    Space is cut in two by a plane across one of its axes, then each half, and so on. The first cut is across the axis
    along which the Gaussians spread most, or the second most in every other `turn`, so that the borders of one round
    of refinement are not those of the next.

    Args:
        gaussians: The map, in the form of `GaussianField.to_numpy`.
        eyes: Cameras and poses of the views.
        scene_depth: Depth of the scene [scene units].
        count: Number of regions. There are fewer if the map has fewer blocks.
        turn: Number of the round.

    Returns:
        The regions. Each Gaussian is an own one of one of them.
    """
    blocks = divide(gaussians["position"], extent_of(gaussians["log_scale"]), SIDE * scene_depth)
    near = seen(np.array([eye.planes(REACH * scene_depth) for eye in eyes]), blocks.boxes)
    whole = np.maximum(near @ blocks.counts, 1)  # number (V,) of Gaussians that each view sees
    everywhere = np.array([eye.planes(np.inf) for eye in eyes])
    return [_region(blocks, members, near, whole, everywhere) for members in _cut(blocks, count, turn)]


def _region(
    blocks: Blocks,
    members: NDArray[np.int64],
    near: NDArray[np.bool_],
    whole: NDArray[np.int64],
    everywhere: NDArray[np.float64],
) -> Region:
    """Return the region of some blocks, given which views (V, B) see which blocks, and the planes (V, 6, 4) of all."""
    views = np.flatnonzero(near[:, members].any(axis=1))
    others = np.setdiff1d(np.arange(len(blocks)), members)
    beside = others[seen(everywhere[views], blocks.boxes[others]).any(axis=0)]
    load = float(((near[:, members] @ blocks.counts[members]) / whole).sum())
    return Region(_members(blocks, members), _members(blocks, beside), views, load)


def _members(blocks: Blocks, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Places of the Gaussians of some blocks, in increasing order."""
    return np.sort(np.concatenate([np.zeros(0, dtype=np.int64), *(blocks.of(number) for number in numbers.tolist())]))


def _cut(blocks: Blocks, count: int, turn: int) -> list[NDArray[np.int64]]:
    """Divide the blocks into `count` groups of numbers, or as many as there are blocks."""
    centre, weight = 0.5 * (blocks.boxes.low + blocks.boxes.high), blocks.counts

    def divided(numbers: NDArray[np.int64], parts: int, rank: int) -> list[NDArray[np.int64]]:
        if parts == 1 or len(numbers) < 2:
            return [numbers]
        here, of = centre[numbers], weight[numbers]
        spread = np.average((here - np.average(here, axis=0, weights=of)) ** 2, axis=0, weights=of)
        axis = np.argsort(-spread, kind="stable")[rank]
        order = numbers[np.argsort(here[:, axis], kind="stable")]
        left = parts // 2
        upto = np.cumsum(weight[order])
        first = int(np.clip(np.searchsorted(upto, upto[-1] * left / parts) + 1, 1, len(order) - 1))
        return divided(order[:first], left, 0) + divided(order[first:], parts - left, 0)

    return divided(np.arange(len(blocks)), count, turn % 2)
