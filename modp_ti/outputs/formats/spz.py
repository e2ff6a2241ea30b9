"""`.spz`: compressed splats of Niantic (nianticlabs/spz), version 3: a gzip stream of a header and six arrays.

    header    uint32 magic, version, count; uint8 SH degree, fractional bits of positions, flags, 0
    position  3 x int24, fixed point      opacity  uint8       colour    3 x uint8, 0.15 f_dc + 0.5
    scale     3 x uint8, 16 (log + 10)    rotation uint32      harmonics uint8, 128 f_rest + 128, colours innermost

All numbers are little-endian. The rotation word stores the index of the largest of x, y, z, w in two bits, then the
other three in order, each as a sign and nine bits from 0 to sqrt(1/2). The axes are right, up, back; those of 3DGS
files are right, down, front.
"""

from __future__ import annotations

import gzip
import os
import struct
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.atomic import replace_file
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.quantised import opacities, smallest_three, to_bits, unit_quaternions

__all__ = ["write_spz"]

MAGIC, VERSION, ANTIALIASED = 0x5053474E, 3, 1
# Resolution of positions, as a fraction of the size (largest axis) that 95 percent of the Gaussians exceed. A finer one
# would store noise that does not compress.
FINEST = 1 / 32
# A rotation by 180 degrees around x flips the sign of the harmonics that are odd in (y, z): degree 1, 2, 3.
TURNED = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], dtype=np.float64)


def write_spz(path: str | os.PathLike[str], state: Mapping[str, NDArray]) -> None:
    """Write Gaussians, marked as trained with anti-aliasing.

    Args:
        path: The file.
        state: Gaussians by name, as from `GaussianField.to_numpy`.

    Raises:
        InputError: If the map's extent exceeds 24-bit positions.
    """
    turn = np.array([1.0, -1.0, -1.0])
    position = state["position"].astype(np.float64) * turn
    extent = max(float(np.abs(position).max(initial=0.0)), 1e-9)
    small = np.exp(np.quantile(state["log_scale"].max(axis=1), 0.05)) if len(position) else 1.0
    fitting = np.floor(np.log2((2**23 - 1) / extent))
    fractional = int(np.clip(np.ceil(-np.log2(FINEST * small)), 0, min(fitting, 23)))
    if fitting < 0:
        raise InputError(
            f"the map reaches {extent:.3g} units from the origin, beyond what .spz holds: take another form"
        )
    fixed = np.round(position * 2.0**fractional).astype("<i4")
    degree = round(state["sh"].shape[1] ** 0.5) - 1
    q = unit_quaternions(state)[:, [1, 2, 3, 0]] * [1.0, -1.0, -1.0, 1.0]
    rest = state["sh"][:, 1:].astype(np.float64) * TURNED[: state["sh"].shape[1] - 1, None]
    arrays = (
        fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3],
        # 0 and 255 are excluded, as their logits are infinite.
        np.clip(to_bits(opacities(state), 8), 1, 254).astype(np.uint8),
        to_bits(0.15 * state["sh"][:, 0].astype(np.float64) + 0.5, 8).astype(np.uint8),
        np.clip(np.round(16.0 * (state["log_scale"].astype(np.float64) + 10.0)), 0, 255).astype(np.uint8),
        _rotations(q),
        np.clip(np.round(128.0 * rest) + 128.0, 0, 255).astype(np.uint8),
    )
    header = struct.pack("<3I4B", MAGIC, VERSION, len(position), degree, fractional, ANTIALIASED, 0)
    content = header + b"".join(array.tobytes() for array in arrays)
    replace_file(path, gzip.compress(content, mtime=0))


def _rotations(q: NDArray[np.float64]) -> NDArray[np.uint32]:
    """Pack unit quaternions x, y, z, w (N, 4) into 32 bits each."""
    largest, others = smallest_three(q)
    packed = largest.astype("<u4")
    for value in others.T:
        packed = packed << 10 | (value < 0).astype("<u4") << 9 | to_bits(np.abs(value) * np.sqrt(2.0), 9)
    return packed.astype("<u4")
