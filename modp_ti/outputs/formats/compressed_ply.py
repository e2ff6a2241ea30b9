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
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import SH_C0
from modp_ti.files.atomic import replace_file
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.splat_packing import (
    logits,
    morton_order,
    opacities,
    packed,
    smallest_three,
    unit_quaternions,
    with_largest,
)
from modp_ti.outputs.formats.splats_ply import COMMENT

__all__ = ["is_compressed_ply", "read_compressed_ply", "write_compressed_ply"]

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
MAX_HEADER = 1 << 14


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
    rest = state["sh"][:, 1:].transpose(0, 2, 1).reshape(len(order), -1).astype(np.float64)
    header = ["ply", "format binary_little_endian 1.0", f"comment {COMMENT}", f"element chunk {len(first)}"]
    header += [f"property float {name}" for name in RANGES]
    header += [f"element vertex {len(order)}"]
    header += [f"property uint {name}" for name in WORDS]
    content = np.concatenate(ranges, axis=1).astype("<f4").tobytes() + words.tobytes()
    if rest.shape[1]:
        header += [f"element sh {len(order)}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
        content += np.clip(np.floor((rest / 8.0 + 0.5) * 256.0), 0, 255).astype(np.uint8).tobytes()
    replace_file(path, ("\n".join([*header, "end_header"]) + "\n").encode("ascii") + content)


def is_compressed_ply(data: bytes) -> bool:
    """Whether the content of a PLY file has the chunks of this format."""
    return data.startswith(b"ply") and b"element chunk " in data[:MAX_HEADER].partition(b"end_header")[0]


def read_compressed_ply(data: bytes, path: Path) -> dict[str, NDArray]:
    """Read the content of a compressed PLY file, as SuperSplat, splat-transform and this module write it.

    Args:
        data: The content.
        path: The file, for error messages.

    Returns:
        Gaussians by name, as `GaussianField.load` takes them.

    Raises:
        InputError: If the file is damaged or laid out in another way.
    """
    head, end, _ = data[:MAX_HEADER].partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    elements = [line for line in lines if line[:1] == ["element"] and len(line) == 3]
    counts = {name: int(number) for _, name, number in elements if number.isdecimal() and len(number) < 10}
    names = [line[2] for line in lines if line[:1] == ["property"] and len(line) == 3]
    count, coefficients = counts.get("vertex", 0), len(names) - len(RANGES) - len(WORDS)
    wanted = RANGES + WORDS + [f"f_rest_{i}" for i in range(coefficients)]
    layout = names == wanted and coefficients in (0, 9, 24, 45)
    if not end or ["format", "binary_little_endian", "1.0"] not in lines or not layout:
        raise InputError(f"{path}: a compressed PLY of another layout than SuperSplat's")
    chunks = -(-count // CHUNK)
    sizes = np.cumsum([len(head) + len(end), 4 * len(RANGES) * chunks, 4 * len(WORDS) * count, coefficients * count])
    if counts.get("chunk") != chunks or counts.get("sh", count) != count or sizes[-1] > len(data):
        raise InputError(f"{path}: the compressed PLY is damaged or cut off")
    ranges = np.frombuffer(data, "<f4", len(RANGES) * chunks, sizes[0]).reshape(chunks, 3, 2, 3).astype(np.float64)
    words = np.frombuffer(data, "<u4", len(WORDS) * count, sizes[1]).reshape(count, len(WORDS))
    rest = np.frombuffer(data, np.uint8, coefficients * count, sizes[2]).reshape(count, 3, -1)
    ranges = ranges[np.arange(count) // CHUNK]

    def between(kind: int, shares: NDArray[np.float64]) -> NDArray[np.float64]:
        return ranges[:, kind, 0] + shares * (ranges[:, kind, 1] - ranges[:, kind, 0])

    rotation = _unpacked(words[:, 1] & np.uint32(0x3FFFFFFF), (10, 10, 10))
    colour = _unpacked(words[:, 3], (8, 8, 8, 8))
    constant = (between(2, colour[:, :3]) - 0.5) / SH_C0
    others = ((rest.astype(np.float64) + 0.5) / 256.0 - 0.5) * 8.0
    return {
        "position": between(0, _unpacked(words[:, 0], (11, 10, 11))),
        "log_scale": between(1, _unpacked(words[:, 2], (11, 10, 11))),
        "quaternion": with_largest((words[:, 1] >> 30).astype(np.int64), (rotation - 0.5) * np.sqrt(2.0)),
        "opacity_logit": logits(colour[:, 3]),
        "sh": np.concatenate([constant[:, None], others.transpose(0, 2, 1)], axis=1),
    }


def _unpacked(words: NDArray, bits: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the numbers (N, len(bits)) in [0, 1] of words (N,), the first from the highest bits."""
    parts = []
    low = sum(bits)
    for count in bits:
        low -= count
        parts.append((words >> np.uint32(low) & np.uint32((1 << count) - 1)) / float((1 << count) - 1))
    return np.stack(parts, axis=1)
