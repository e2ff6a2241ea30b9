"""`Observations`: positions at which frames observe points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Observations"]


@dataclass(frozen=True)
class Observations:
    """Observations of points in frames.

    Attributes:
        frame: (M,) int64 frame of each observation.
        point: (M,) int64 point of each observation.
        rays: (M, 2) normalised coordinates.
        sigma: (M,) uncertainty in normalised coordinates: one pixel of the image used for detection.
    """

    frame: NDArray[np.int64]
    point: NDArray[np.int64]
    rays: NDArray[np.float64]
    sigma: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.frame)

    def where(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> Observations:
        """Select observations by a mask (M,) or indices (K,)."""
        return Observations(self.frame[kept], self.point[kept], self.rays[kept], self.sigma[kept])

    def beside(self, other: Observations) -> Observations:
        """Concatenate with observations of other points, which are renumbered to follow these."""
        first = int(self.point.max()) + 1 if len(self) else 0
        return Observations(
            np.concatenate([self.frame, other.frame]),
            np.concatenate([self.point, other.point + first]),
            np.concatenate([self.rays, other.rays]),
            np.concatenate([self.sigma, other.sigma]),
        )
