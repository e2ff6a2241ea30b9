"""Compressed PLY of PlayCanvas and SuperSplat: 16 bytes per Gaussian, in chunks of 256 with their own value ranges.

    chunk   18 x float32: minimum and maximum of position, then log scale, then colour of its Gaussians
    vertex  uint32 packed_position, packed_rotation, packed_scale, packed_color
    sh      uchar f_rest_0 ...: steps of 8 / 256 from -4, all of red first; only if the map has them

Positions and log scales store x, y, z in 11, 10, 11 bits between the chunk's minimum and maximum. The colour word
stores red, green, blue (0.5 + 0.2820948 f_dc) between their bounds and the opacity, in 8 bits each. The rotation word
stores the index of the largest of w, x, y, z in two bits, then the other three in order in 10 bits each, from
-sqrt(1/2) to sqrt(1/2). The first value of a word is in the highest bits. All numbers are little-endian.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import SH_C0
from modp_ti.files.atomic import replace_file
from modp_ti.outputs.formats.splat_packing import morton_order, opacities, packed, smallest_three, unit_quaternions
from modp_ti.outputs.formats.splats_ply import COMMENT

CHUNK = 256
RANGES = [
    f"{bound}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for bound in ("min", "max")
    for name in names
]
WORDS = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]
# Log scales are clipped to this magnitude; larger ones are not meaningful.
LARGEST_LOG_SCALE = 20.0


def write_compressed_ply(path: str | os.PathLike[str], state: Mapping[str, NDArray]) -> None:
    """Write Gaussians, reordered so that neighbours in space share a chunk.

    Args:
        path: The file.
        state: Gaussians by name, as from `GaussianField.to_numpy`.
    """
    order = morton_order(state["position"])
    state = {name: values[order] for name, values in state.items()}
    first = np.arange(0, len(order), CHUNK)
    chunk = np.arange(len(order)) // CHUNK
    ranges, relative = [], []
    log_scale = np.clip(state["log_scale"].astype(np.float64), -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE)
    for values in (state["position"], log_scale, 0.5 + SH_C0 * state["sh"][:, 0]):
        values = values.astype(np.float32).astype(np.float64)
        low = np.minimum.reduceat(values, first) if len(first) else values
        high = np.maximum.reduceat(values, first) if len(first) else values
        ranges += [low, high]
        relative.append((values - low[chunk]) / np.maximum(high - low, 1e-12)[chunk])
    words = np.zeros((len(order), 4), "<u4")
    words[:, 0] = packed(relative[0].T, (11, 10, 11))
    largest, others = smallest_three(unit_quaternions(state))
    words[:, 1] = largest.astype(np.uint32) << 30 | packed(others.T / np.sqrt(2.0) + 0.5, (10, 10, 10))
    words[:, 2] = packed(relative[1].T, (11, 10, 11))
    words[:, 3] = packed([*relative[2].T, opacities(state)], (8, 8, 8, 8))
    rest = state["sh"][:, 1:].transpose(0, 2, 1).astype(np.float64)
    rest = rest.reshape(len(order), rest[0].size if len(rest) else 0)
    header = ["ply", "format binary_little_endian 1.0", f"comment {COMMENT}", f"element chunk {len(first)}"]
    header += [f"property float {name}" for name in RANGES]
    header += [f"element vertex {len(order)}"]
    header += [f"property uint {name}" for name in WORDS]
    content = np.concatenate(ranges, axis=1).astype("<f4").tobytes() + words.tobytes()
    if rest.shape[1]:
        header += [f"element sh {len(order)}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
        content += np.clip(np.floor((rest / 8.0 + 0.5) * 256.0), 0, 255).astype(np.uint8).tobytes()
    replace_file(path, ("\n".join([*header, "end_header"]) + "\n").encode("ascii") + content)
