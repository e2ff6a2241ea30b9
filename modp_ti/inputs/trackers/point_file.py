"""World points in a file of their own: PLY, or text with `x y z` a line."""

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
    """Positions (N, 3) of a PLY file, or of text whose lines begin with `x y z`.

    Raises InputError, with the line where there is one, for a file that is neither or holds no point.
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
