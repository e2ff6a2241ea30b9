"""`.spz`: compressed splats of Niantic (nianticlabs/spz), versions 2 to 4.

Up to version 3, a file is a gzip stream of a header and six arrays. All numbers are little-endian.

    header    uint32 magic, version, count; uint8 SH degree, fractional bits of positions, flags, 0
    position  3 x int24, fixed point      opacity  uint8       colour    3 x uint8, 0.15 f_dc + 0.5
    scale     3 x uint8, 16 (log + 10)    rotation uint32      harmonics uint8, 128 f_rest + 128, colours innermost

The rotation word stores the index of the largest of x, y, z, w in two bits, then the other three in order, each as a
sign and nine bits from 0 to sqrt(1/2). Version 2 stores x, y, z as 3 x uint8 from -1 to 1, with w >= 0.

Version 4 has the arrays of version 3, each compressed with Zstandard. The bytes before them are not compressed:

    header    as above, with the number of arrays as its last byte; uint32 place of the table; 12 bytes of 0
    table     2 x uint64 per array: compressed and uncompressed size; empty arrays are left out

The axes are right, up, back; those of 3DGS files are right, down, front. Writers with anti-aliasing set the first flag.
"""

from __future__ import annotations

import gzip
import os
import struct
from collections.abc import Mapping
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.atomic import replace_file
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.splat_packing import (
    HALF_TURN,
    TURNED,
    opacities,
    packed,
    smallest_three,
    to_bits,
    unit_quaternions,
)

# The version that most viewers read.
DEFAULT_VERSION = 3
MAGIC, ANTIALIASED = 0x5053474E, 1
HEADER, TABLE_ENTRY = struct.Struct("<3I4B"), struct.Struct("<2Q")
TABLE_START = 32
# Resolution of positions, as a fraction of the size (largest axis) that 95 percent of the Gaussians exceed. A finer one
# would store noise that does not compress.
FINEST = 1 / 32
# Resolution that is coarse enough for a note, as a fraction of the same size.
COARSEST = 1 / 4


def write_spz(path: str | os.PathLike[str], state: Mapping[str, NDArray], version: int = DEFAULT_VERSION) -> str:
    """Write Gaussians, marked as trained with anti-aliasing.

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
    if fitting < 0:
        raise InputError(
            f"the map reaches {extent:.3g} units from the origin, beyond what .spz holds: take another form"
        )
    step = 2.0**-fractional
    note = ""
    if step > COARSEST * small:
        note = (
            f"the map reaches {extent:.3g} units from the origin, so that .spz rounds positions to {step:.2g}: move it "
            "to the origin, or take another form"
        )
    fixed = np.round(position * 2.0**fractional).astype("<i4")
    degree = round(state["sh"].shape[1] ** 0.5) - 1
    rest = state["sh"][:, 1:].astype(np.float64) * TURNED[: state["sh"].shape[1] - 1, None]
    arrays = (
        fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3],
        # 0 and 255 are excluded, as their logits are infinite.
        np.clip(to_bits(opacities(state), 8), 1, 254).astype(np.uint8),
        to_bits(0.15 * state["sh"][:, 0].astype(np.float64) + 0.5, 8).astype(np.uint8),
        np.clip(np.round(16.0 * (state["log_scale"].astype(np.float64) + 10.0)), 0, 255).astype(np.uint8),
        _rotations(unit_quaternions(state)[:, [1, 2, 3, 0]] * np.append(HALF_TURN, 1.0), version),
        np.clip(np.round(128.0 * rest) + 128.0, 0, 255).astype(np.uint8),
    )
    parts = [array.tobytes() for array in arrays]
    if version < 4:
        header = HEADER.pack(MAGIC, version, len(position), degree, fractional, ANTIALIASED, 0)
        replace_file(path, gzip.compress(header + b"".join(parts), mtime=0))
        return note
    parts = [part for part in parts if part]
    streams = [_zstandard().ZstdCompressor(level=12).compress(part) for part in parts]
    header = HEADER.pack(MAGIC, version, len(position), degree, fractional, ANTIALIASED, len(parts))
    header += struct.pack("<I", TABLE_START) + bytes(12)
    table = b"".join(TABLE_ENTRY.pack(len(there), len(here)) for there, here in zip(streams, parts, strict=True))
    replace_file(path, header + table + b"".join(streams))
    return note


def _rotations(q: NDArray[np.float64], version: int) -> NDArray[np.generic]:
    """Pack unit quaternions x, y, z, w (N, 4)."""
    if version == 2:
        q = q * np.where(q[:, 3:] < 0, -1.0, 1.0)
        return np.round(127.5 * q[:, :3] + 127.5).astype(np.uint8)
    largest, others = smallest_three(q)
    components = [part for value in others.T for part in ((value < 0).astype(np.float64), np.abs(value) * np.sqrt(2.0))]
    return (largest.astype(np.uint32) << 30 | packed(components, (1, 9) * 3)).astype("<u4")


def _zstandard() -> ModuleType:
    try:
        import zstandard
    except ImportError:
        raise InputError("version 4 of .spz needs a package: pip install zstandard") from None
    return zstandard
