"""Reads and writes splats in the format that a file's content or its name tells."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import read_bytes
from modp_ti.files.errors import InputError
from modp_ti.files.reading import reading
from modp_ti.outputs.formats.compressed_ply import is_compressed_ply, read_compressed_ply, write_compressed_ply
from modp_ti.outputs.formats.ksplat import read_ksplat, write_ksplat
from modp_ti.outputs.formats.sog import read_sog, write_sog
from modp_ti.outputs.formats.splat_glb import write_splat_glb
from modp_ti.outputs.formats.splats_ply import read_splats, write_splats
from modp_ti.outputs.formats.spz import DEFAULT_VERSION, read_spz, write_spz
from modp_ti.outputs.formats.web_splat import read_web_splat, write_web_splat

__all__ = ["convert_splats", "read_any_splats"]

# By the end of the name, the longer first.
WRITERS: dict[str, Callable[[Path, dict[str, NDArray]], object]] = {
    ".compressed.ply": write_compressed_ply,
    ".ply": write_splats,
    ".spz": write_spz,
    ".sog": write_sog,
    ".splat": write_web_splat,
    ".ksplat": write_ksplat,
    ".glb": write_splat_glb,
}
READERS = {".spz": read_spz, ".sog": read_sog, ".splat": read_web_splat, ".ksplat": read_ksplat}


def read_any_splats(path: Path) -> dict[str, NDArray[np.float32]]:
    """Read splats: PLY of 3DGS, compressed PLY, `.spz`, `.sog`, `.splat` or `.ksplat`.

    Raises:
        InputError: If the file is of none of these formats, is damaged, or holds no splats or infinite numbers.
    """
    suffix = path.suffix.lower()
    if suffix != ".ply" and suffix not in READERS:
        raise InputError(f"{path}: splats are read from .ply, {', '.join(READERS)}")
    try:
        data = read_bytes(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    with reading(path), np.errstate(all="ignore"):  # infinite numbers are found below
        if suffix in READERS:
            state = READERS[suffix](data, path)
        else:
            state = read_compressed_ply(data, path) if is_compressed_ply(data) else read_splats(path)
        state = {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in state.items()}
    if len(state["position"]) == 0:
        raise InputError(f"{path}: holds no splat")
    for name, values in state.items():
        if not np.isfinite(values).all():
            raise InputError(f"{path}: the {name.replace('_', ' ')} of a splat is not finite; the file is damaged")
    # A rotation of zeros, as 8 bits may round to, is none.
    state["quaternion"][(state["quaternion"] == 0).all(axis=1)] = 1.0, 0.0, 0.0, 0.0
    return state


def convert_splats(
    source: Path, target: Path, spz_version: int = DEFAULT_VERSION, note: Callable[[str], object] = str
) -> int:
    """Read splats and write them in the format that the target's name tells. Its folder is made.

    Args:
        source: The file to read.
        target: The file to write, another one.
        spz_version: Version of an `.spz` file.
        note: Called with a note for the user, if there is one.

    Returns:
        The number of Gaussians.

    Raises:
        InputError: If a format is unknown, the source is damaged, or the target cannot be written.
    """
    suffix = next((suffix for suffix in WRITERS if target.name.lower().endswith(suffix)), None)
    if suffix is None:
        raise InputError(f"{target}: splats are written to a file in {', '.join(WRITERS)}")
    if os.path.realpath(target) == os.path.realpath(source):  # `resolve` raises for a link to itself
        raise InputError(f"{target}: is the source itself; name another file")
    state = read_any_splats(source)
    try:
        target.absolute().parent.mkdir(parents=True, exist_ok=True)
        if suffix == ".spz":
            if said := write_spz(target, state, spz_version):
                note(said)
        else:
            WRITERS[suffix](target, state)
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror or error}") from None
    return len(state["position"])
