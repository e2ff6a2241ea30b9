"""`.spz`: compressed splats of Niantic (nianticlabs/spz), versions 1 to 4 to read, 2 to 4 to write.

Up to version 3, a file is a gzip stream of a header and six arrays. All numbers are little-endian.

    header    uint32 magic, version, count; uint8 SH degree, fractional bits of positions, flags, 0
    position  3 x int24, fixed point      opacity  uint8       colour    3 x uint8, 0.15 f_dc + 0.5
    scale     3 x uint8, 16 (log + 10)    rotation uint32      harmonics uint8, 128 f_rest + 128, colours innermost

The rotation word stores the index of the largest of x, y, z, w in two bits, then the other three in order, each as a
sign and nine bits from 0 to sqrt(1/2). Versions 1 and 2 store x, y, z as 3 x uint8 from -1 to 1, with w >= 0, and
version 1 has positions in float16.

Version 4 has the arrays of version 3, each compressed with Zstandard. The bytes before them are not compressed:

    header    as above, with the number of arrays as its last byte; uint32 place of the table; 12 bytes of 0
    table     2 x uint64 per array: compressed and uncompressed size; empty arrays are left out

The axes are right, up, back; those of 3DGS files are right, down, front. Writers with anti-aliasing set the first flag.
"""

from __future__ import annotations

import gzip
import os
import struct
import zlib
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.atomic import replace_file
from modp_ti.files.errors import InputError
from modp_ti.files.limits import most_unpacked
from modp_ti.outputs.formats.splat_packing import (
    logits,
    opacities,
    packed,
    smallest_three,
    to_bits,
    unit_quaternions,
    with_largest,
)

__all__ = ["DEFAULT_VERSION", "read_spz", "write_spz"]

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
# A rotation by 180 degrees around x flips the sign of the harmonics that are odd in (y, z): degree 1, 2, 3.
TURNED = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], dtype=np.float64)
HALF_TURN = np.array([1.0, -1.0, -1.0])
# Largest number of Gaussians that is read, and the most bytes of extensions.
MOST, MOST_EXTRA = 100_000_000, 1 << 20


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


def read_spz(data: bytes, path: Path) -> dict[str, NDArray]:
    """Read the content of an `.spz` file. Harmonics beyond degree 3 and extensions are left out.

    Args:
        data: The content.
        path: The file, for error messages.

    Returns:
        Gaussians by name, as `GaussianField.load` takes them.

    Raises:
        InputError: If the file is damaged or of an unknown version, or a package is missing.
    """
    header, arrays = _plain(data, path) if data.startswith(b"NGSP") else _unzipped(data, path)
    version, count, fractional = header
    positions, alphas, colours, scales, rotations, rest = arrays
    if version == 1:
        position = positions.view("<f2").astype(np.float64)
    else:
        fixed = np.zeros((count, 3, 4), np.uint8)
        fixed[..., 1:] = positions.reshape(count, 3, 3)
        position = (fixed.view("<i4")[..., 0] >> 8) / 2.0**fractional
    rest = (rest.reshape(count, -1, 3)[:, :15].astype(np.float64) - 128.0) / 128.0
    constant = (colours / 255.0 - 0.5) / 0.15
    sh = np.concatenate([constant[:, None], rest * TURNED[: rest.shape[1], None]], axis=1)
    quaternion = _quaternions(rotations, version) * np.append(HALF_TURN, 1.0)
    return {
        "position": position * HALF_TURN,
        "log_scale": scales / 16.0 - 10.0,
        "quaternion": quaternion[:, [3, 0, 1, 2]],
        "opacity_logit": logits(alphas[:, 0] / 255.0),
        "sh": sh,
    }


def _rotations(q: NDArray[np.float64], version: int) -> NDArray[np.generic]:
    """Pack unit quaternions x, y, z, w (N, 4)."""
    if version == 2:
        q = q * np.where(q[:, 3:] < 0, -1.0, 1.0)
        return np.round(127.5 * q[:, :3] + 127.5).astype(np.uint8)
    largest, others = smallest_three(q)
    components = [part for value in others.T for part in ((value < 0).astype(np.float64), np.abs(value) * np.sqrt(2.0))]
    return (largest.astype(np.uint32) << 30 | packed(components, (1, 9) * 3)).astype("<u4")


def _quaternions(rotations: NDArray[np.uint8], version: int) -> NDArray[np.float64]:
    """Return quaternions x, y, z, w (N, 4); the inverse of `_rotations`."""
    if version < 3:
        xyz = rotations / 127.5 - 1.0
        return np.column_stack([xyz, np.sqrt(np.maximum(1.0 - (xyz**2).sum(axis=1), 0.0))])
    words = rotations.view("<u4")[:, 0]
    parts = [words >> np.uint32(low) & np.uint32(1023) for low in (20, 10, 0)]
    values = [np.where(part & 512, -1.0, 1.0) * (part & 511) / 511.0 * np.sqrt(0.5) for part in parts]
    return with_largest((words >> 30).astype(np.int64), np.stack(values, axis=1))


def _sizes(version: int, degree: int) -> list[int]:
    """Bytes per Gaussian of each array."""
    return [6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * ((degree + 1) ** 2 - 1)]


def _header(data: bytes, path: Path, size: int) -> tuple[int, int, int, int, int]:
    """Return version, count, degree, fractional bits and the last byte of a header, for a file of `size` bytes."""
    if len(data) < HEADER.size:
        raise InputError(f"{path}: the .spz file is damaged or cut off")
    magic, version, count, degree, fractional, _, last = HEADER.unpack_from(data)
    if magic != MAGIC or not 1 <= version <= 4 or degree > 4 or fractional > 24 or count > MOST:
        raise InputError(f"{path}: not an .spz file of version 1 to 4")
    if count == 0:
        raise InputError(f"{path}: holds no splat")
    if count * sum(_sizes(version, degree)) > most_unpacked(size):
        raise InputError(f"{path}: {count:,} splats cannot be in {size:,} bytes; the .spz file is damaged")
    return version, count, degree, fractional, last


def _unzipped(data: bytes, path: Path) -> tuple[tuple[int, int, int], list[NDArray[np.uint8]]]:
    """Return version, count and fractional bits, and the arrays (N, size), of a file up to version 3."""
    try:
        stream = zlib.decompressobj(wbits=31)
        head = stream.decompress(data, HEADER.size)
        version, count, degree, fractional, _ = _header(head, path, len(data))
        sizes = _sizes(version, degree)
        content = stream.decompress(stream.unconsumed_tail, count * sum(sizes))
        stream.decompress(stream.unconsumed_tail, MOST_EXTRA)
    except zlib.error:
        raise InputError(f"{path}: not an .spz file, or a damaged one") from None
    if version == 4 or len(content) < count * sum(sizes) or not stream.eof:
        raise InputError(f"{path}: the .spz file is damaged or cut off")
    ends = count * np.cumsum([0, *sizes])
    parts = [content[start:end] for start, end in pairwise(ends.tolist())]
    arrays = [np.frombuffer(part, np.uint8).reshape(count, size) for part, size in zip(parts, sizes, strict=True)]
    return (version, count, fractional), arrays


def _plain(data: bytes, path: Path) -> tuple[tuple[int, int, int], list[NDArray[np.uint8]]]:
    """Return the same of a file of version 4."""
    version, count, degree, fractional, streams = _header(data, path, len(data))
    damaged = InputError(f"{path}: the .spz file is damaged or cut off")
    sizes = _sizes(version, degree)
    wanted = [size * count for size in sizes if size * count]
    table = struct.unpack_from("<I", data, HEADER.size)[0] if len(data) >= TABLE_START else len(data)
    at = table + TABLE_ENTRY.size * streams
    if version != 4 or streams < len(wanted) or at > len(data):
        raise damaged
    zstandard = _zstandard()
    parts = []
    for number, size in enumerate(wanted):
        there, here = TABLE_ENTRY.unpack_from(data, table + TABLE_ENTRY.size * number)
        part = data[at : at + there]
        at += there
        try:
            if here != size or zstandard.frame_content_size(part) not in (-1, size):
                raise damaged
            parts.append(zstandard.ZstdDecompressor().decompress(part, max_output_size=size))
        except zstandard.ZstdError:
            raise damaged from None
        if len(parts[-1]) != size:
            raise damaged
    parts += [b""] * (len(sizes) - len(parts))
    arrays = [np.frombuffer(part, np.uint8).reshape(count, size) for part, size in zip(parts, sizes, strict=True)]
    return (version, count, fractional), arrays


def _zstandard() -> ModuleType:
    try:
        import zstandard
    except ImportError:
        raise InputError("version 4 of .spz needs a package: pip install zstandard") from None
    return zstandard
