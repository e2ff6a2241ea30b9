"""`.splat`: 32 bytes per Gaussian, the format of the first web viewers (antimatter15/splat), which most still read.

    position 3 x float32 | scale 3 x float32, linear | colour and opacity 4 x uint8 | quaternion w x y z 4 x uint8

All numbers are little-endian. A component c of the unit quaternion is stored as round(128 c) + 128. There is no header.
The most important Gaussians come first, because viewers show what they have loaded so far. Colours do not depend on the
view direction.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import SH_C0
from modp_ti.files.atomic import replace_file
from modp_ti.outputs.formats.splat_packing import opacities, to_bits, unit_quaternions

RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


def write_web_splat(path: str | os.PathLike[str], state: Mapping[str, NDArray]) -> None:
    """Write Gaussians with the constant part of their colours, clipped to [0, 1].

    Args:
        path: The file.
        state: Gaussians by name, as from `GaussianField.to_numpy`.
    """
    opacity = opacities(state)
    importance = opacity * np.exp(state["log_scale"].astype(np.float64).sum(axis=1))
    order = np.argsort(-importance, kind="stable")
    table = np.zeros(len(order), RECORD)
    table["position"] = state["position"][order]
    table["scale"] = np.exp(state["log_scale"][order])
    table["rgba"][:, :3] = to_bits(0.5 + SH_C0 * state["sh"][order, 0], 8)
    table["rgba"][:, 3] = to_bits(opacity[order], 8)
    table["rotation"] = np.clip(np.round(unit_quaternions(state)[order] * 128.0) + 128.0, 0, 255)
    replace_file(path, table.tobytes())
