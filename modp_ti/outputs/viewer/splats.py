"""Conversion of Gaussians to the splats that a browser draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import matrices_from_unit_quaternions
from fields.map.gaussians import SH_C0

__all__ = ["Splats", "splats_of"]


@dataclass(frozen=True)
class Splats:
    """Splats in the page's units.

    Attributes:
        centres: (N, 3).
        covariances: (N, 3, 3).
        colours: (N, 3) uint8.
        opacities: (N, 1) uint8.
        of: Number of Gaussians of the map, which may be larger than N.
    """

    centres: NDArray[np.float32]
    covariances: NDArray[np.float32]
    colours: NDArray[np.uint8]
    opacities: NDArray[np.uint8]
    of: int


def splats_of(state: Mapping[str, NDArray], units: float, limit: int) -> Splats:
    """Convert Gaussians, named as in `GaussianField.to_numpy`, to splats with their constant (degree 0) colours.

    If there are more than `limit`, every n-th Gaussian is kept and enlarged to cover the area of those left out.
    `units` is the number of page units per world unit.
    """
    count = len(state["position"])
    chosen = np.arange(count) if count <= limit else np.arange(limit) * count // limit
    larger = np.sqrt(count / len(chosen)) if len(chosen) else 1.0
    q = state["quaternion"][chosen].astype(np.float32)
    R = matrices_from_unit_quaternions(q / np.linalg.norm(q, axis=1, keepdims=True))
    M = R * (np.exp(state["log_scale"][chosen]) * np.float32(units * larger))[:, None, :]
    opacity = 1.0 / (1.0 + np.exp(-state["opacity_logit"][chosen]))
    colour = np.clip(0.5 + SH_C0 * state["sh"][chosen, 0], 0.0, 1.0)
    return Splats(
        state["position"][chosen] * np.float32(units),
        M @ M.transpose(0, 2, 1),
        np.round(255.0 * colour).astype(np.uint8),
        np.round(255.0 * opacity[:, None]).astype(np.uint8),
        count,
    )
