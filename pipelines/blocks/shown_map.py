"""`ShownMap`: a map of any size, of which the part that a view sees is loaded before it is rendered."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from fields.map.blocks import planes_of, seen
from fields.map.gaussians import GaussianField
from pipelines.blocks.hierarchy import Hierarchy

__all__ = ["ShownMap"]


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
        self._hierarchy = None if self.fits else Hierarchy(self.values)

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
        if self._hierarchy is None:
            self.gaussians.load(self.values)
            return
        hierarchy = self._hierarchy
        planes = planes_of(camera, T_camera_world, np.inf)[None]
        chosen = np.flatnonzero(seen(planes, hierarchy.blocks.boxes)[0])
        eye = inverse_se3(T_camera_world)[:3, 3]
        levels = hierarchy.levels_for(chosen, eye, camera.fx, self.gaussians.capacity)
        self.gaussians.load(hierarchy.gaussians(chosen, levels))
