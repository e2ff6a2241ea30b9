"""`ShownMap`: a map of any size, of which the part that a view sees is loaded before it is rendered."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from fields.map.blocks import Blocks, divide, extent_of, planes_of, seen
from fields.map.gaussians import GaussianField

__all__ = ["ShownMap"]

# Number of Gaussians of a block, about.
GAUSSIANS_EACH = 50


class ShownMap:
    """Loads a map into a pool. If it does not fit, only the part that a view sees is loaded, the nearest blocks first.

    Args:
        gaussians: The pool, whose Gaussians are replaced.
        values: The map, in the form of `GaussianField.to_numpy`.

    Raises:
        ValueError: From `show`, as in `GaussianField.load`.
    """

    def __init__(self, gaussians: GaussianField, values: Mapping[str, NDArray]) -> None:
        self.gaussians = gaussians
        self.values = dict(values)
        self._blocks: Blocks | None = None
        if not self.fits:
            position = self.values["position"].astype(np.float64)
            self._blocks = divide(position, extent_of(self.values["log_scale"]), _side(position))

    @property
    def fits(self) -> bool:
        """Whether the whole map fits into the pool, so that one call of `show` serves for all views."""
        return len(self.values["position"]) <= self.gaussians.capacity

    def show(self, camera: PinholeCamera, T_camera_world: NDArray[np.float64]) -> None:
        """Load the map, or the part of it that a view sees.

        Args:
            camera: The view's camera.
            T_camera_world: Its pose (4, 4).
        """
        if self._blocks is None:
            self.gaussians.load(self.values)
            return
        blocks = self._blocks
        chosen = np.flatnonzero(seen(planes_of(camera, T_camera_world, np.inf)[None], blocks.boxes)[0])
        distance = blocks.boxes[chosen].distance(inverse_se3(T_camera_world)[:3, 3])
        chosen = chosen[np.argsort(distance, kind="stable")]
        chosen = chosen[np.cumsum(blocks.counts[chosen]) <= self.gaussians.capacity]
        members = np.concatenate([np.zeros(0, dtype=np.int64), *(blocks.of(block) for block in chosen.tolist())])
        self.gaussians.load({name: array[members] for name, array in self.values.items()})


def _side(position: NDArray[np.float64]) -> float:
    """Side of cubes that hold about `GAUSSIANS_EACH` positions (N, 3) of surfaces. Outliers do not count."""
    low, high = np.quantile(position, [0.02, 0.98], axis=0)
    return float(np.prod(np.sort(high - low)[1:]) * GAUSSIANS_EACH / len(position)) ** 0.5 or 1.0
