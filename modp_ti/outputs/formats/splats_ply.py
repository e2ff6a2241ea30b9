"""`splats.ply`: Gaussians in the PLY layout of 3DGS, which splat viewers read."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import NO_ORIGIN
from fields.runtime.process import give_back_pages
from modp_ti.files import read_bytes
from modp_ti.files.atomic import replacing
from modp_ti.files.errors import InputError
from modp_ti.files.ply import parse_ply_header
from modp_ti.files.reading import open_file

# The filter that the map was optimised with: 0.3 px^2 of blur and the opacity compensation of mip-splatting. Other
# renderers must use the same to reproduce the images. Brush and splat-transform read this comment and do so by
# themselves.
COMMENT = "SplatRenderMode: mip"
# The logit of an opacity half a step of eight bits below 1, which an infinite one is read as.
LARGEST_LOGIT = np.log(254.5 / 0.5)
# Number of Gaussians that are written together, which bounds the memory that this takes.
ROWS_EACH = 1 << 16


def _names(sh_count: int) -> list[str]:
    rest = [f"f_rest_{i}" for i in range(3 * (sh_count - 1))]
    return [
        *"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity",
        "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
    ]  # fmt: skip


def write_splats(
    path: str | os.PathLike[str], state: dict[str, NDArray], origin: NDArray[np.float64] = NO_ORIGIN
) -> None:
    """Write Gaussians as a 3DGS PLY file. The file appears whole or not at all.

    Opacities are logits, scales are logarithms, quaternions have w first, and `f_rest` holds all of red first. All
    values are written unchanged, so that the file renders identically when read back.

    Args:
        path: The file.
        state: Gaussians by name, as from `GaussianField.to_numpy`.
        origin: Where their origin lies in the world (3,), which a comment says if it is not zero.

    Raises:
        OSError: If the file cannot be written.

    Example:
        modp_ti.write_splats("splats.ply", mapper.pipeline.gaussians.to_numpy())
    """
    with replacing(path) as file:
        for piece in _pieces(state, origin):
            file.write(piece)


def check_splats(
    path: str | os.PathLike[str], state: dict[str, NDArray], origin: NDArray[np.float64] = NO_ORIGIN
) -> None:
    """Check that a file reads back, byte for byte, as `write_splats` has written it.

    Args:
        path: The file.
        state: The Gaussians that were written.
        origin: Their origin.

    Raises:
        InputError: If it does not, or cannot be read.
    """
    try:
        with open_file(path) as file:
            same = all(file.read(len(piece)) == piece for piece in _pieces(state, origin)) and not file.read(1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read back: {error.strerror}") from None
    if not same:
        raise InputError(f"{path}: is not read back as it was written; check the disk, or choose another output folder")


def _pieces(state: dict[str, NDArray], origin: NDArray[np.float64]) -> Iterator[bytes]:
    """Yield the content of the file, a part of the rows at a time."""
    n, sh_count, _ = state["sh"].shape
    header = ["ply", "format binary_little_endian 1.0", f"comment {COMMENT}", f"element vertex {n}"]
    if origin.any():
        header.insert(3, f"comment origin {' '.join(map(repr, origin.tolist()))}")
    header += [f"property float {name}" for name in _names(sh_count)]
    yield ("\n".join([*header, "end_header"]) + "\n").encode("ascii")
    for first in range(0, n, ROWS_EACH):
        yield _table({name: array[first : first + ROWS_EACH] for name, array in state.items()}).tobytes()
        give_back_pages(*state.values())


def _table(state: dict[str, NDArray]) -> NDArray[np.float32]:
    """Return Gaussians as the rows of the file."""
    n, sh_count, _ = state["sh"].shape
    columns = [
        state["position"],
        np.zeros((n, 3)),
        state["sh"][:, 0],
        state["sh"][:, 1:].transpose(0, 2, 1).reshape(n, 3 * (sh_count - 1)),
        state["opacity_logit"][:, None],
        state["log_scale"],
        state["quaternion"],
    ]
    return np.concatenate(columns, axis=1).astype("<f4")


def read_splats(path: str | os.PathLike[str]) -> dict[str, NDArray[np.float32]]:
    """Read the Gaussians of a 3DGS PLY file. Its properties may come in any order.

    Args:
        path: The file.

    Returns:
        Gaussians by name, as `GaussianField.load` takes them.

    Raises:
        InputError: If the file is not a 3DGS PLY file, is truncated or lacks a property. The message has one line.

    Example:
        centres = modp_ti.read_splats("out/room/splats.ply")["position"]  # (N, 3)
    """
    file = Path(path)
    try:
        data = read_bytes(file)
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror}") from None
    header = parse_ply_header(data, file)
    names, count = header.names, header.count
    if header.form != "binary_little_endian":
        raise InputError(f"{file}: not a binary little-endian PLY file, which 3DGS splats are")
    if any(kind != "f4" for _, kind in header.properties):
        raise InputError(f"{file}: all properties of 3DGS splats are float")
    table = np.frombuffer(data, dtype="<f4", count=count * len(names), offset=header.start).reshape(count, len(names))
    column = {name: i for i, name in enumerate(names)}
    rest = sum(name.startswith("f_rest_") for name in names)
    missing = [name for name in _names(1 + rest // 3) if name not in column and not name.startswith("n")]
    if missing or rest not in (0, 9, 24, 45):
        raise InputError(f"{file}: not 3DGS splats; {missing[0] if missing else f'{rest} f_rest'} does not fit")

    def columns(*wanted: str, may_be_infinite: bool = False) -> NDArray[np.float32]:
        values = np.ascontiguousarray(table[:, [column[name] for name in wanted]])
        if may_be_infinite:
            values = np.where(np.isinf(values), np.copysign(LARGEST_LOGIT, values), values).astype(np.float32)
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise InputError(f"{file}: Gaussian {bad[0]} holds NaN or infinite numbers; the file is damaged")
        return values

    sh = np.empty((count, 1 + rest // 3, 3), dtype=np.float32)
    sh[:, 0] = columns("f_dc_0", "f_dc_1", "f_dc_2")
    if rest:
        sh[:, 1:] = columns(*(f"f_rest_{i}" for i in range(rest))).reshape(count, 3, rest // 3).transpose(0, 2, 1)
    return {
        "position": columns("x", "y", "z"),
        "log_scale": columns("scale_0", "scale_1", "scale_2"),
        "quaternion": columns("rot_0", "rot_1", "rot_2", "rot_3"),
        # Other programs write an infinite logit for an opacity that eight bits hold as 0 or 1.
        "opacity_logit": columns("opacity", may_be_infinite=True)[:, 0],
        "sh": sh,
    }
