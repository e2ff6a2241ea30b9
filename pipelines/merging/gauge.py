"""Exposures of several maps in one gauge.

An exposure (A, b) turns the colours of a map into those of an image, image = A colour + b. A map fixes its exposures
only up to an affine transform of all colours, by the first keyframe, which has none. Where two maps have frames in
common, the exposures of these frames tell the transform between their colours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import SH_C0
from pipelines.render.cpu.photometric_model import IDENTITY

__all__ = ["colour_changes", "exposed_in", "recoloured"]

Exposures = Mapping[int, NDArray[np.float64]]


def colour_changes(maps: Sequence[Exposures]) -> list[NDArray[np.float64]]:
    """Return the transforms (3, 4) of the colours of each map to those of the first one.

    Each map is compared with the one before it, in the frames that both have an exposure of; it takes over the
    transform of that one if there are none.

    Args:
        maps: Exposure (3, 4) of each frame of each map, by frame index.
    """
    changes = [np.array(IDENTITY)]
    for before, here in pairwise(maps):
        found = [_after(_inverse(before[i]), here[i]) for i in sorted(set(before) & set(here))]
        change = np.mean(found, axis=0) if found else np.array(IDENTITY)
        changes.append(_after(changes[-1], change))
    return changes


def recoloured(sh: NDArray[np.floating], change: NDArray[np.float64]) -> NDArray[np.floating]:
    """Return the coefficients (N, K, 3) of colours after a transform (3, 4) of these colours."""
    changed = sh.astype(np.float64) @ change[:, :3].T
    changed[:, 0] += (change[:, :3].sum(axis=1) * 0.5 + change[:, 3] - 0.5) / SH_C0
    return changed.astype(sh.dtype)


def exposed_in(exposure: NDArray[np.float64], change: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the exposure (3, 4) with which a frame's image stays the same when the colours are transformed (3, 4)."""
    return _after(exposure, _inverse(change))


def _after(second: NDArray[np.float64], first: NDArray[np.float64]) -> NDArray[np.float64]:
    """The transform (3, 4) that applies `first`, and then `second`."""
    return np.column_stack([second[:, :3] @ first[:, :3], second[:, :3] @ first[:, 3] + second[:, 3]])


def _inverse(transform: NDArray[np.float64]) -> NDArray[np.float64]:
    A = np.asarray(np.linalg.inv(transform[:, :3]), dtype=np.float64)
    return np.column_stack([A, -A @ transform[:, 3]])
