"""The file of a snapshot: NumPy's .npz of plain arrays, one of which is JSON. Nothing in it is ever run.

The archive is read by its own rules and not by `numpy.load`: every array must be stored as it is, and as long as its
header says, before anything of its size is made.
"""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.atomic import replacing
from modp_ti.files.errors import InputError

__all__ = ["FILE", "VERSION", "read_arrays", "write_arrays"]

FILE = "snapshot.npz"
# Of what stands in the arrays and in the JSON. A file of another version is refused: it holds the state of other code.
VERSION = 1
ABOUT = "about"
KINDS = "biuf"


def write_arrays(path: Path, arrays: Mapping[str, NDArray], about: Mapping[str, Any]) -> None:
    """Write arrays of numbers by name, and what JSON can hold; the file before stays until this one is on the disk.

    Raises OSError where it cannot be written.
    """
    text = json.dumps({"version": VERSION, **about}).encode("utf-8")
    with replacing(path) as file:
        np.savez(file, allow_pickle=False, **arrays, **{ABOUT: np.frombuffer(text, dtype=np.uint8)})


def read_arrays(path: Path) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """The arrays and the JSON of a file that `write_arrays` wrote.

    Raises InputError (one line) for a file that is missing, damaged, none of ours or of another version.
    """
    try:
        size = os.path.getsize(path)
        with zipfile.ZipFile(path) as archive:
            arrays = {name: _array(archive, info, size) for name, info in _members(archive, size).items()}
        about = json.loads(bytes(arrays.pop(ABOUT)))
        version = about["version"]
    except OSError as error:
        raise InputError(f"{path}: the snapshot cannot be read: {error.strerror}") from None
    except (zipfile.BadZipFile, ValueError, KeyError, TypeError, NotImplementedError, RuntimeError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: no snapshot, or a damaged one ({reason}); start the run from its scene") from None
    if version != VERSION:
        raise InputError(
            f"{path}: a snapshot of version {version}, this program reads {VERSION}: resume it with the program that "
            "wrote it, or start the run from its scene"
        )
    return arrays, about


def _members(archive: zipfile.ZipFile, size: int) -> dict[str, zipfile.ZipInfo]:
    members = {}
    total = 0
    for info in archive.infolist():
        total += info.file_size
        if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size or total > size:
            raise ValueError(f"{info.filename} is not stored as it is")
        if not info.filename.endswith(".npy") or info.filename[:-4] in members:
            raise ValueError(f"{info.filename} is no array, or is there twice")
        members[info.filename[:-4]] = info
    return members


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo, size: int) -> NDArray:
    data = archive.read(info)  # at most as long as the file; its checksum is looked at
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise ValueError(f"{info.filename} is an array of format {version}")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.kind not in KINDS or fortran or dtype.hasobject or any(side < 0 for side in shape):
        raise ValueError(f"{info.filename} holds {dtype}, not plain numbers")
    start = stream.tell()
    if math.prod(shape) * dtype.itemsize != len(data) - start:
        raise ValueError(f"{info.filename} is not as long as it says")
    return np.frombuffer(data, dtype=dtype, offset=start).reshape(shape).copy()
