"""`.ksplat`, the format of GaussianSplats3D, version 0.1: a header, headers of sections, and the sections.

    header    4096 bytes: uint8 major, minor version; uint32 at 4: most sections, sections, most splats, splats;
              uint16 at 20: level; float32 at 24: centre of the scene; at 36: least and greatest harmonic of level 2
    section   1024 bytes: uint32 splats, most splats, splats per bucket, buckets; float32 size of a bucket;
              uint16 at 20: bytes per bucket; uint32 at 24: range of positions; uint32 at 32: full buckets, partly
              filled ones; uint16 at 40: SH degree

A section holds a uint32 per partly filled bucket, the number of its Gaussians; the centres of the buckets, 3 x float32;
and the Gaussians, in the order of the buckets, the full ones first:

    level                   0        1        2
    position                float32  uint16   uint16    in its bucket, see `_positions`
    scale, linear           float32  float16  float16
    quaternion w, x, y, z   float32  float16  float16
    colour and opacity      uint8    uint8    uint8
    harmonics               float32  float16  uint8     of degree 1 and 2: red, green, blue of each degree

All numbers are little-endian, and the axes are those of 3DGS files.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import SH_C0
from modp_ti.files.atomic import replace_file
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.splat_packing import logits, opacities, to_bits, unit_quaternions

__all__ = ["read_ksplat", "write_ksplat"]

HEADER, SECTION_HEADER = 4096, 1024
# The written level, and the harmonics' range of files that state none.
LEVEL, HARMONIC = 1, 1.5
# The largest float16.
HALF = 65504.0
# Positions in a bucket: 0 to 2 * RANGE over its size. A bucket holds at most BUCKET Gaussians.
RANGE, BUCKET = 32767, 256
CODES = 1 << 16
# Resolution of positions, as a fraction of the size (largest axis) that 95 percent of the Gaussians exceed.
FINEST = 1 / 32
# SH coefficients of each degree beyond the constant one.
DEGREES = {0: (), 1: (3,), 2: (3, 5), 3: (3, 5, 7)}


def _record(level: int, degree: int) -> np.dtype:
    """Return the layout of a Gaussian."""
    position, number, harmonic = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))[level]
    fields = [("position", position, 3), ("scale", number, 3), ("rotation", number, 4), ("rgba", "u1", 4)]
    if degree:
        fields.append(("harmonics", harmonic, 3 * sum(DEGREES[degree])))
    return np.dtype(fields)


def write_ksplat(path: str | os.PathLike[str], state: Mapping[str, NDArray]) -> None:
    """Write Gaussians with level 1, in one section. Harmonics beyond degree 2 are left out.

    Args:
        path: The file.
        state: Gaussians by name, as from `GaussianField.to_numpy`.
    """
    position = state["position"].astype(np.float64)
    size, low = _bucket_size(state), position.min(axis=0)
    # Cells of a grid, each with as many full buckets as it has Gaussians for and a partly filled one for the rest.
    cells, cell, counts = np.unique(np.floor((position - low) / size), axis=0, return_inverse=True, return_counts=True)
    full, rest = counts // BUCKET, counts % BUCKET
    order = np.argsort(cell, kind="stable")
    place = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    in_full = place < np.repeat(full * BUCKET, counts)
    order = np.concatenate([order[in_full], order[~in_full]])
    middles = (low + (cells + 0.5) * size).astype("<f4")
    offset = position[order] - middles[cell[order]]
    centres = np.concatenate([np.repeat(middles, full, axis=0), middles[rest > 0]])
    state = {name: values[order] for name, values in state.items()}
    count, degree = len(order), min(round(state["sh"].shape[1] ** 0.5) - 1, 2)
    table = np.zeros(count, _record(LEVEL, degree))
    table["position"] = np.clip(np.round(offset * (RANGE / (size / 2)) + RANGE), 0, CODES - 1)
    table["scale"] = np.exp(np.minimum(state["log_scale"].astype(np.float64), np.log(HALF)))
    table["rotation"] = unit_quaternions(state)
    table["rgba"][:, :3] = to_bits(0.5 + SH_C0 * state["sh"][:, 0], 8)
    table["rgba"][:, 3] = to_bits(opacities(state), 8)
    if degree:
        parts = np.split(state["sh"][:, 1 : (degree + 1) ** 2], np.cumsum(DEGREES[degree])[:-1], axis=1)
        table["harmonics"] = np.concatenate([part.transpose(0, 2, 1).reshape(count, -1) for part in parts], axis=1)
    filled = rest[rest > 0].astype("<u4")
    header, section = bytearray(HEADER), bytearray(SECTION_HEADER)
    struct.pack_into("<BBxx4IH", header, 0, 0, 1, 1, 1, count, count, LEVEL)
    struct.pack_into("<5f", header, 24, *((low + position.max(axis=0)) / 2), -HARMONIC, HARMONIC)
    struct.pack_into("<4IfH", section, 0, count, count, BUCKET, len(centres), size, 12)
    struct.pack_into("<I", section, 24, RANGE)
    struct.pack_into("<IIH", section, 32, int(full.sum()), len(filled), degree)
    replace_file(path, bytes(header + section) + filled.tobytes() + centres.tobytes() + table.tobytes())


def read_ksplat(data: bytes, path: Path) -> dict[str, NDArray]:
    """Read the content of a `.ksplat` file.

    Args:
        data: The content.
        path: The file, for error messages.

    Returns:
        Gaussians by name, as `GaussianField.load` takes them.

    Raises:
        InputError: If the file is damaged.
    """
    damaged = InputError(f"{path}: not a .ksplat file of version 0.1, or a damaged one")
    if len(data) < HEADER:
        raise damaged
    major, minor, sections, _, _, _, level = struct.unpack_from("<BBxx4IH", data)
    least, greatest = struct.unpack_from("<2f", data, 36)
    least, greatest = (least, greatest) if least < greatest else (-HARMONIC, HARMONIC)
    at = HEADER + SECTION_HEADER * sections
    if (major, minor) != (0, 1) or level > 2 or at > len(data):
        raise damaged
    states = []
    for number in range(sections):
        state, at = _section(data, HEADER + SECTION_HEADER * number, at, level, (least, greatest), damaged)
        states.append(state)
    if not states:
        raise damaged
    degree = min(state["sh"].shape[1] for state in states)
    for state in states:
        state["sh"] = state["sh"][:, :degree]
    return {name: np.concatenate([state[name] for state in states]) for name in states[0]}


def _section(
    data: bytes, header: int, at: int, level: int, harmonics: tuple[float, float], damaged: InputError
) -> tuple[dict[str, NDArray], int]:
    """Read a section whose data start at `at`. Returns its Gaussians and the end of its data."""
    count, room, per_bucket, buckets, extent = struct.unpack_from("<4If", data, header)
    (stride,) = struct.unpack_from("<H", data, header + 20)
    (most,) = struct.unpack_from("<I", data, header + 24)
    full, partly, degree = struct.unpack_from("<IIH", data, header + 32)
    if degree > 3 or count > room or (level and (stride != 12 or full + partly != buckets)):
        raise damaged
    record = _record(level, degree)
    # Python's integers do not overflow: the numbers are compared with the file before anything is allocated.
    first = at + 4 * partly
    start = first + stride * buckets
    end = start + record.itemsize * room
    if end > len(data):
        raise damaged
    table = np.frombuffer(data, record, count, start)
    position = table["position"]
    if level:
        filled = np.frombuffer(data, "<u4", partly, at).astype(np.int64)
        held = np.concatenate([np.full(full, per_bucket, np.int64) if full else np.zeros(0, np.int64), filled])
        if full * per_bucket + sum(filled.tolist()) != count:
            raise damaged
        centres = np.frombuffer(data, "<f4", 3 * buckets, first).reshape(-1, 3).astype(np.float64)
        position = _positions(position, np.repeat(centres, held, axis=0), extent, most or RANGE)
    scale, rotation = table["scale"].astype(np.float64), table["rotation"].astype(np.float64)
    if not (scale >= 0).all():
        raise damaged
    sh = np.zeros((count, (degree + 1) ** 2, 3))
    sh[:, 0] = (table["rgba"][:, :3] / 255.0 - 0.5) / SH_C0
    if degree:
        values = table["harmonics"].astype(np.float64)
        if level == 2:
            values = harmonics[0] + values / 255.0 * (harmonics[1] - harmonics[0])
        for part, size in zip(
            np.split(values, 3 * np.cumsum(DEGREES[degree])[:-1], axis=1), DEGREES[degree], strict=True
        ):
            place = (size // 2) ** 2
            sh[:, place : place + size] = part.reshape(count, 3, size).transpose(0, 2, 1)
    state = {
        "position": position,
        # Scales that float16 rounded to 0 are its smallest number.
        "log_scale": np.log(np.maximum(scale, 2.0**-24)),
        "quaternion": rotation,
        "opacity_logit": logits(table["rgba"][:, 3] / 255.0),
        "sh": sh,
    }
    return state, end


def _bucket_size(state: Mapping[str, NDArray]) -> float:
    """Return the size of buckets in which the code of a position is fine enough for all but the smallest Gaussians."""
    small = np.exp(np.quantile(state["log_scale"].max(axis=1), 0.05))
    return float(np.float32(max(2.0 * RANGE * FINEST * small, 1e-9)))


def _positions(
    codes: NDArray[np.uint16], centres: NDArray[np.float64], extent: float, most: int
) -> NDArray[np.float64]:
    """Return positions (N, 3) from their codes: `most` is the centre of the bucket, 0 half of its extent before it."""
    return (codes.astype(np.float64) - most) * (extent / 2 / most) + centres
