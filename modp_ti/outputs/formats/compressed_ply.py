"""Compressed PLY of PlayCanvas and SuperSplat: 16 bytes per Gaussian, in chunks of 256 with their own value ranges.

    chunk   18 x float32: minimum and maximum of position, then log scale, then colour of its Gaussians
    vertex  uint32 packed_position, packed_rotation, packed_scale, packed_color
    sh      uchar f_rest_0 ...: steps of 8 / 256 from -4, all of red first; only if the map has them

Positions and log scales store x, y, z in 11, 10, 11 bits between the chunk's minimum and maximum. The colour word
stores red, green, blue (0.5 + 0.2820948 f_dc) between their bounds and the opacity, in 8 bits each. The rotation word
stores the index of the largest of w, x, y, z in two bits, then the other three in order in 10 bits each, from
-sqrt(1/2) to sqrt(1/2). The first value of a word is in the highest bits.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import SH_C0
from modp_ti.files.atomic import replace_file
from modp_ti.outputs.formats.quantised import opacities, smallest_three, to_bits, unit_quaternions
from modp_ti.outputs.formats.splats_ply import COMMENT

__all__ = ["write_compressed_ply"]

CHUNK = 256
RANGES = [
    f"{bound}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for bound in ("min", "max")
    for name in names
]
# Log scales are clipped to this magnitude; larger ones are not meaningful.
LARGEST_LOG_SCALE = 20.0


def write_compressed_ply(path: str | os.PathLike[str], state: Mapping[str, NDArray]) -> None:
    """Write Gaussians, reordered so that neighbours in space share a chunk.

    Args:
        path: The file.
        state: Gaussians by name, as from `GaussianField.to_numpy`.
    """
    order = _morton_order(state["position"])
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
    packed = np.zeros((len(order), 4), "<u4")
    packed[:, 0] = _packed(relative[0].T, (11, 10, 11))
    largest, others = smallest_three(unit_quaternions(state))
    packed[:, 1] = largest.astype(np.uint32) << 30 | _packed(others.T / np.sqrt(2.0) + 0.5, (10, 10, 10))
    packed[:, 2] = _packed(relative[1].T, (11, 10, 11))
    packed[:, 3] = _packed([*relative[2].T, opacities(state)], (8, 8, 8, 8))
    rest = state["sh"][:, 1:].transpose(0, 2, 1).reshape(len(order), -1).astype(np.float64)
    header = ["ply", "format binary_little_endian 1.0", f"comment {COMMENT}", f"element chunk {len(first)}"]
    header += [f"property float {name}" for name in RANGES]
    header += [f"element vertex {len(order)}"]
    header += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    content = np.concatenate(ranges, axis=1).astype("<f4").tobytes() + packed.tobytes()
    if rest.shape[1]:
        header += [f"element sh {len(order)}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
        content += np.clip(np.floor((rest / 8.0 + 0.5) * 256.0), 0, 255).astype(np.uint8).tobytes()
    replace_file(path, ("\n".join([*header, "end_header"]) + "\n").encode("ascii") + content)


def _packed(parts: NDArray[np.float64] | list[NDArray[np.float64]], bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """Pack numbers in [0, 1] into one word with the given bits each, the first in the highest bits."""
    word = np.zeros(len(parts[0]), np.uint32)
    for part, count in zip(parts, bits, strict=True):
        word = word << np.uint32(count) | to_bits(part, count)
    return word


def _morton_order(position: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the order (N,) along a Morton curve with 10 bits per coordinate."""
    if len(position) == 0:
        return np.zeros(0, np.int64)
    low, high = position.min(axis=0), position.max(axis=0)
    cell = to_bits((position - low) / np.maximum(high - low, 1e-12), 10).astype(np.uint64)
    key = np.zeros(len(position), np.uint64)
    for bit in range(10):
        for axis in range(3):
            key |= (cell[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(key, kind="stable")
