"""`Observations`: which frame sees which point where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Observations"]


@dataclass(frozen=True)
class Observations:
    """What is seen of which point where.

    frame, point: (M,) int64. rays: (M, 2) ideal coordinates. sigma: (M,) their uncertainty, one pixel of
    detection.
    """

    frame: NDArray[np.int64]
    point: NDArray[np.int64]
    rays: NDArray[np.float64]
    sigma: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.frame)

    def where(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> Observations:
        """Those of a mask (M,) or of places (K,)."""
        return Observations(self.frame[kept], self.point[kept], self.rays[kept], self.sigma[kept])

    def beside(self, other: Observations) -> Observations:
        """These and the other ones, which are of other points."""
        first = int(self.point.max()) + 1 if len(self) else 0
        return Observations(
            np.concatenate([self.frame, other.frame]),
            np.concatenate([self.point, other.point + first]),
            np.concatenate([self.rays, other.rays]),
            np.concatenate([self.sigma, other.sigma]),
        )
