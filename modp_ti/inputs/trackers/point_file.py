"""World points from a separate file: PLY, or text with `x y z` per line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import open_file
from modp_ti.files.errors import InputError
from modp_ti.files.number_rows import read_number_rows
from modp_ti.inputs.trackers.point_cloud import read_ply_points

__all__ = ["read_point_file"]


def read_point_file(path: Path) -> NDArray[np.float64]:
    """Read positions (N, 3) from a PLY file, or from text whose lines begin with `x y z`.

    Raises:
        InputError: If the file is neither or has no points. For text, the message names the line.
    """
    try:
        with open_file(path) as file:
            is_ply = file.read(3) == b"ply"
    except FileNotFoundError:
        raise InputError(f"{path}: no such file (tracker.points)") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror} (tracker.points)") from None
    if is_ply:
        xyz = read_ply_points(path)
        if len(xyz) == 0:
            raise InputError(f"{path}: holds no point (tracker.points); leave the key out to have points triangulated")
        return xyz
    return read_number_rows(path, 3, "x y z", "tracker.points", more=True).values
