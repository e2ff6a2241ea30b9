"""The view from above: the up direction, and the part of the map below the cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import camera_centres
from fields.map.gaussians import SH_C0

__all__ = ["Plan", "floor_plan", "plan_of"]

# Maximum number of Gaussians drawn, and their minimum opacity.
MOST_SHOWN = 20_000
LEAST_OPACITY = 0.5


@dataclass(frozen=True)
class Plan:
    """Axes of a view from above.

    Attributes:
        right: (3,) unit vector to the right of the page.
        ahead: (3,) unit vector to the top of the page.
        up: (3,) unit vector towards the reader.
    """

    right: NDArray[np.float64]
    ahead: NDArray[np.float64]
    up: NDArray[np.float64]

    def on_page(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project world points (N, 3) to the page (N, 2)."""
        return points @ np.stack([self.right, self.ahead], axis=1)


def plan_of(poses: Sequence[NDArray[np.float64]]) -> Plan:
    """Return the plan for cameras at T_camera_world (4, 4).

    Up is the cameras' mean up direction. The longest extent of the path is horizontal, and the first camera faces the
    top of the page.
    """
    T = np.asarray(poses)
    rotations = T[:, :3, :3]
    centres = camera_centres(T)
    up = _unit(-rotations[:, 1].mean(axis=0), -rotations[0, 1])
    flat = centres - centres.mean(axis=0)
    flat = flat - np.outer(flat @ up, up)
    axes = np.linalg.svd(flat, full_matrices=True)[2]
    anyhow = np.cross(np.eye(3)[np.argmin(np.abs(up))], up)
    right = axes[0] - (axes[0] @ up) * up
    right = _unit(right if np.abs(flat).max() > 1e-9 else rotations[0, 0] - (rotations[0, 0] @ up) * up, anyhow)
    ahead = np.cross(up, right)
    if rotations[0, 2] @ ahead < 0:
        right, ahead = -right, -ahead
    return Plan(right, ahead, up)


def floor_plan(
    plan: Plan, gaussians: Mapping[str, NDArray], centres: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return page positions (N, 2) and colours (N, 3) of the opaque Gaussians below the cameras, lowest first.

    Args:
        plan: The axes of the view.
        gaussians: Arrays by name, as from `GaussianField.to_numpy`.
        centres: (M, 3) camera centres. Gaussians above their median height are left out.
    """
    position = np.asarray(gaussians["position"], dtype=np.float64)
    opaque = np.asarray(gaussians["opacity_logit"]).ravel() > np.log(LEAST_OPACITY / (1 - LEAST_OPACITY))
    height = position @ plan.up
    shown = np.flatnonzero(opaque & (height <= np.median(centres @ plan.up)) & np.isfinite(position).all(axis=1))
    shown = shown[:: max(1, -(-len(shown) // MOST_SHOWN))]
    shown = shown[np.argsort(height[shown], kind="stable")]
    colour = 0.5 + SH_C0 * np.asarray(gaussians["sh"], dtype=np.float64)[shown, 0]
    return plan.on_page(position[shown]), np.clip(colour, 0.0, 1.0)


def _unit(v: NDArray[np.float64], otherwise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normalise `v`, or `otherwise` if `v` is close to zero."""
    v = v if np.linalg.norm(v) > 1e-6 else otherwise
    return v / np.linalg.norm(v)
