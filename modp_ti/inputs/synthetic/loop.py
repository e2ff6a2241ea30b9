"""What a tracker's small errors add up to along a loop: a world that shifts, turns and grows until the loop closes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.synthetic.camera_path import LOOP_CLOSES

__all__ = ["Loop"]

# Ways of the drift: of the shift, and the axis of the turn.
SHIFT = np.array([0.6, 0.64, 0.48])
AXIS = np.array([0.48, -0.36, 0.8])


@dataclass(frozen=True)
class Loop:
    """A way that comes back to its beginning, and what happens to the tracker's poses on it.

    drift: of the world at the loop's end: its shift [scene depths], its turn [radians], and the growth of its scale
    [natural logarithm]. corrected: the tracker sees that the loop is closed, revises all poses and points, and drifts
    no more; otherwise it drifts on.
    """

    drift: float = 0.0
    corrected: bool = False

    @staticmethod
    def closed_at(share: float) -> bool:
        """Whether the camera is back at its beginning after this share of its way in [0, 1]."""
        return share >= LOOP_CLOSES

    def drifted_world(
        self, share: float, T_camera_world: NDArray[np.float64], scene_depth: float
    ) -> NDArray[np.float64]:
        """S (4, 4) that takes places to where the tracker believes them after this share of its way.

        T_camera_world (4, 4): the first camera, about whose centre the world turns and grows.
        """
        amount = self.drift * share / LOOP_CLOSES
        centre = -T_camera_world[:3, :3].T @ T_camera_world[:3, 3]
        S = np.eye(4)
        S[:3, :3] = np.exp(amount) * cv2.Rodrigues(amount * AXIS)[0]
        S[:3, 3] = centre - S[:3, :3] @ centre + amount * scene_depth * SHIFT
        return S
