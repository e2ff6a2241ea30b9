"""Compressed splats as a table: `.splat`, compressed PLY and `.spz`; `sog.py` and `gltf.py` hold the other layouts.

All numbers are little-endian. The first value of a packed word is in its highest bits.

`.splat`, of the first web viewers (antimatter15/splat): 32 bytes per Gaussian, the most important first, no header.

    position 3 x float32 | scale 3 x float32, linear | colour and opacity 4 x uint8 | quaternion w x y z 4 x uint8

A component c of the unit quaternion is stored as round(128 c) + 128. Colours do not depend on the view direction.

Compressed PLY, of PlayCanvas and SuperSplat: 16 bytes per Gaussian, in chunks of 256 with their own value ranges.

    chunk   18 x float32: minimum and maximum of position, then log scale, then colour of its Gaussians
    vertex  uint32 packed_position, packed_rotation, packed_scale, packed_color
    sh      uchar f_rest_0 ...: steps of 8 / 256 from -4, all of red first; only if the map has them

Positions and log scales store x, y, z in 11, 10, 11 bits between the chunk's minimum and maximum. The colour word
stores red, green, blue (0.5 + 0.2820948 f_dc) between their bounds and the opacity, in 8 bits each. The rotation word
stores the index of the largest of w, x, y, z in two bits, then the other three in order in 10 bits each, from
-sqrt(1/2) to sqrt(1/2).

`.spz`, of Niantic (nianticlabs/spz), versions 2 to 4. Up to version 3, it is a gzip stream of a header and six arrays.

    header    uint32 magic, version, count; uint8 SH degree, fractional bits of positions, flags, 0
    position  3 x int24, fixed point      opacity  uint8       colour    3 x uint8, 0.15 f_dc + 0.5
    scale     3 x uint8, 16 (log + 10)    rotation uint32      harmonics uint8, 128 f_rest + 128, colours innermost

The rotation word stores the index of the largest of x, y, z, w in two bits, then the other three in order, each as a
sign and nine bits from 0 to sqrt(1/2). Version 2 stores x, y, z as 3 x uint8 from -1 to 1, with w >= 0. Version 4 has
the arrays of version 3, each compressed with Zstandard. The bytes before them are not compressed:

    header    as above, with the number of arrays as its last byte; uint32 place of the table; 12 bytes of 0
    table     2 x uint64 per array: compressed and uncompressed size; empty arrays are left out

The axes of `.spz` are right, up, back; those of 3DGS files are right, down, front.
"""

from __future__ import annotations

import gzip
import os
import struct
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import SH_C0
from modp_ti.files.atomic import replace_file
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.splats_ply import COMMENT

# A rotation by 180 degrees around x, to axes with y up: of positions, and of the harmonics of degree 1, 2 and 3, of
# which those that are odd in (y, z) change their sign.
HALF_TURN = np.array([1.0, -1.0, -1.0])
TURNED = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], dtype=np.float64)

RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])

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

# The version that most viewers read.
SPZ_VERSION = 3
MAGIC, ANTIALIASED = 0x5053474E, 1
HEADER, TABLE_START = struct.Struct("<3I4B"), 32
# Resolution of positions, as a fraction of the size (largest axis) that 95 percent of the Gaussians exceed. A finer one
# would store noise that does not compress. From COARSEST on, a note says so.
FINEST, COARSEST = 1 / 32, 1 / 4


def write_web_splat(path: str | os.PathLike[str], state: Mapping[str, NDArray]) -> None:
    """Write Gaussians as `.splat`, with the constant part of their colours, clipped to [0, 1].

    Args:
        path: The file.
        state: Gaussians by name, as from `GaussianField.to_numpy`.
    """
    opacity = opacities(state)
    order = np.argsort(-opacity * np.exp(state["log_scale"].astype(np.float64).sum(axis=1)), kind="stable")
    table = np.zeros(len(order), RECORD)
    table["position"] = state["position"][order]
    table["scale"] = np.exp(state["log_scale"][order])
    table["rgba"][:, :3] = to_bits(0.5 + SH_C0 * state["sh"][order, 0], 8)
    table["rgba"][:, 3] = to_bits(opacity[order], 8)
    table["rotation"] = np.clip(np.round(unit_quaternions(state)[order] * 128.0) + 128.0, 0, 255)
    replace_file(path, table.tobytes())


def write_compressed_ply(path: str | os.PathLike[str], state: Mapping[str, NDArray]) -> None:
    """Write Gaussians as compressed PLY, reordered so that neighbours in space share a chunk.

    Args:
        path: The file.
        state: Gaussians by name, as from `GaussianField.to_numpy`.
    """
    order = morton_order(state["position"])
    state = {name: values[order] for name, values in state.items()}
    count, harmonics = state["sh"].shape[:2]
    first, chunk = np.arange(0, count, CHUNK), np.arange(count) // CHUNK
    ranges, relative = [], []
    log_scale = np.clip(state["log_scale"].astype(np.float64), -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE)
    for values in (state["position"], log_scale, 0.5 + SH_C0 * state["sh"][:, 0]):
        values = values.astype(np.float32).astype(np.float64)
        low = np.minimum.reduceat(values, first) if count else values
        high = np.maximum.reduceat(values, first) if count else values
        ranges += [low, high]
        relative.append((values - low[chunk]) / np.maximum(high - low, 1e-12)[chunk])
    largest, others = smallest_three(unit_quaternions(state))
    words = np.zeros((count, 4), "<u4")
    words[:, 0] = packed(relative[0].T, (11, 10, 11))
    words[:, 1] = largest.astype(np.uint32) << 30 | packed(others.T / np.sqrt(2.0) + 0.5, (10, 10, 10))
    words[:, 2] = packed(relative[1].T, (11, 10, 11))
    words[:, 3] = packed([*relative[2].T, opacities(state)], (8, 8, 8, 8))
    rest = state["sh"][:, 1:].transpose(0, 2, 1).reshape(count, 3 * (harmonics - 1)).astype(np.float64)
    header = ["ply", "format binary_little_endian 1.0", f"comment {COMMENT}", f"element chunk {len(first)}"]
    header += [f"property float {name}" for name in RANGES]
    header += [f"element vertex {count}", *(f"property uint {name}" for name in WORDS)]
    content = np.concatenate(ranges, axis=1).astype("<f4").tobytes() + words.tobytes()
    if rest.shape[1]:
        header += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
        content += np.clip(np.floor((rest / 8.0 + 0.5) * 256.0), 0, 255).astype(np.uint8).tobytes()
    replace_file(path, ("\n".join([*header, "end_header"]) + "\n").encode("ascii") + content)


def write_spz(path: str | os.PathLike[str], state: Mapping[str, NDArray], version: int = SPZ_VERSION) -> str:
    """Write Gaussians as `.spz`, marked as trained with anti-aliasing.

    Args:
        path: The file.
        state: Gaussians by name, as from `GaussianField.to_numpy`.
        version: 2, 3 or 4. Version 4 needs the package `zstandard`.

    Returns:
        A note for the user if the map is so far from the origin that small Gaussians move visibly, else "".

    Raises:
        InputError: If the map's extent exceeds 24-bit positions, or a package is missing.
    """
    position = state["position"].astype(np.float64) * HALF_TURN
    extent = max(float(np.abs(position).max(initial=0.0)), 1e-9)
    small = np.exp(np.quantile(state["log_scale"].max(axis=1), 0.05)) if len(position) else 1.0
    fitting = np.floor(np.log2((2**23 - 1) / extent))
    fractional = int(np.clip(np.ceil(-np.log2(FINEST * small)), 0, min(fitting, 23)))
    far = f"the map reaches {extent:.3g} units from the origin, so that .spz rounds positions to {2.0**-fractional:.2g}"
    if fitting < 0:
        raise InputError(f"{path}: {far}: choose another format")
    fixed = np.round(position * 2.0**fractional).astype("<i4")
    degree = round(state["sh"].shape[1] ** 0.5) - 1
    rest = state["sh"][:, 1:].astype(np.float64) * TURNED[: state["sh"].shape[1] - 1, None]
    q = unit_quaternions(state)[:, [1, 2, 3, 0]] * np.append(HALF_TURN, 1.0)
    if version == 2:
        rotation = np.round(127.5 * (q * np.where(q[:, 3:] < 0, -1.0, 1.0))[:, :3] + 127.5).astype(np.uint8)
    else:
        largest, others = smallest_three(q)
        signed = [part for value in others.T for part in ((value < 0).astype(float), np.abs(value) * np.sqrt(2.0))]
        rotation = (largest.astype(np.uint32) << 30 | packed(signed, (1, 9) * 3)).astype("<u4")
    arrays = (
        fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3],
        # 0 and 255 are excluded, as their logits are infinite.
        np.clip(to_bits(opacities(state), 8), 1, 254).astype(np.uint8),
        to_bits(0.15 * state["sh"][:, 0].astype(np.float64) + 0.5, 8).astype(np.uint8),
        np.clip(np.round(16.0 * (state["log_scale"].astype(np.float64) + 10.0)), 0, 255).astype(np.uint8),
        rotation,
        np.clip(np.round(128.0 * rest) + 128.0, 0, 255).astype(np.uint8),
    )
    parts = [array.tobytes() for array in arrays if array.size]
    facts = MAGIC, version, len(position), degree, fractional, ANTIALIASED
    if version < 4:
        replace_file(path, gzip.compress(HEADER.pack(*facts, 0) + b"".join(parts), mtime=0))
    else:
        try:
            import zstandard
        except ImportError:
            raise InputError("version 4 of .spz needs a package: pip install zstandard") from None
        streams = [zstandard.ZstdCompressor(level=12).compress(part) for part in parts]
        table = b"".join(struct.pack("<2Q", len(s), len(part)) for s, part in zip(streams, parts, strict=True))
        head = HEADER.pack(*facts, len(parts)) + struct.pack("<I", TABLE_START) + bytes(12)
        replace_file(path, head + table + b"".join(streams))
    return f"{far}: move it to the origin, or choose another format" if 2.0**-fractional > COARSEST * small else ""


# ---- quantisation ------------------------------------------------------------------------------------------------


def opacities(state: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Return the opacity (N,) of every Gaussian, in (0, 1)."""
    return 1.0 / (1.0 + np.exp(-state["opacity_logit"].astype(np.float64)))


def unit_quaternions(state: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Return the rotations (N, 4) as unit quaternions w, x, y, z."""
    q = state["quaternion"].astype(np.float64)
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def smallest_three(q: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Split unit quaternions (N, 4) into the index of the largest component (N,) and the other three (N, 3), in order.

    The sign is chosen such that the largest component is positive and need not be stored.
    """
    largest = np.abs(q).argmax(axis=1)
    rows = np.arange(len(q))
    q = q * np.where(q[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = q[np.arange(4) != largest[:, None]].reshape(-1, 3)
    return largest, others


def to_bits(values: NDArray, bits: int) -> NDArray[np.uint32]:
    """Quantise values in [0, 1], after clipping, to the nearest of the levels 0 to 2^bits - 1."""
    most = (1 << bits) - 1
    return np.round(np.clip(values, 0.0, 1.0) * most).astype(np.uint32)


def packed(parts: NDArray[np.float64] | list[NDArray[np.float64]], bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """Pack numbers in [0, 1] into one word with the given bits each, the first in the highest bits."""
    word = np.zeros(len(parts[0]), np.uint32)
    for part, count in zip(parts, bits, strict=True):
        word = word << np.uint32(count) | to_bits(part, count)
    return word


def morton_order(position: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the order (N,) along a Morton curve with 10 bits per coordinate. What is far outside, as sky, is last."""
    if len(position) == 0:
        return np.zeros(0, np.int64)
    low, high = np.quantile(position, [0.02, 0.98], axis=0)
    place = ((position - low) / np.maximum(high - low, 1e-12) + 1.0) / 3.0
    cell = to_bits(place, 10).astype(np.uint64)
    key = ((place < 0.0) | (place > 1.0)).any(axis=1).astype(np.uint64) << np.uint64(30)
    for bit in range(10):
        for axis in range(3):
            key |= (cell[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(key, kind="stable")
