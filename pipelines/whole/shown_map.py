"""`ShownMap`: a map of any size, of which the part that a view sees is loaded before it is rendered."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from fields.map.blocks import Blocks, divide, extent_of, planes_of, seen
from fields.map.gaussians import GaussianField
from fields.runtime.process import give_back_heap, give_back_pages
from pipelines.whole.hierarchy import Hierarchy, side_of

# Number of Gaussians of a block, about.
GAUSSIANS_EACH = 50


class ShownMap:
    """Loads a map into a pool. If it does not fit, only the part that a view sees is loaded.

    If that does not fit either, far blocks are loaded with less detail, see `Hierarchy`.

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
        self._hierarchy: Hierarchy | None = None
        if not self.fits:
            position, extent = self.values["position"], extent_of(self.values["log_scale"])
            give_back_pages(*self.values.values())
            # Smaller blocks than those of the hierarchy, of which views see less in vain.
            self._blocks = divide(position, extent, side_of(position, GAUSSIANS_EACH))
            give_back_pages(*self.values.values())
            give_back_heap()

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
        blocks = self._blocks
        if blocks is None:
            self.gaussians.load(self.values)
            return
        self.gaussians.load(self._seen(blocks, camera, T_camera_world))
        give_back_pages(*self.values.values())

    def _seen(self, blocks: Blocks, camera: PinholeCamera, T_camera_world: NDArray[np.float64]) -> dict[str, NDArray]:
        """Return the Gaussians of the blocks that a view sees, or fewer that stand for them."""
        planes = planes_of(camera, T_camera_world, np.inf)[None]
        chosen = np.flatnonzero(seen(planes, blocks.boxes)[0])
        if blocks.counts[chosen].sum() <= self.gaussians.capacity:
            members = np.concatenate([np.zeros(0, dtype=np.int64), *(blocks.of(block) for block in chosen.tolist())])
            return {name: array[members] for name, array in self.values.items()}
        if self._hierarchy is None:
            self._hierarchy = Hierarchy(self.values)
        chosen = np.flatnonzero(seen(planes, self._hierarchy.blocks.boxes)[0])
        eye = inverse_se3(T_camera_world)[:3, 3]
        levels = self._hierarchy.levels_for(chosen, eye, camera.fx, self.gaussians.capacity)
        return self._hierarchy.gaussians(chosen, levels)
