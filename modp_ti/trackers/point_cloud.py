"""Points without observations: read from a PLY file, and shown to each camera as far as it can see them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.tracked_frame import SparsePoints
from modp_ti.errors import InputError
from modp_ti.sources import Undistorter
from modp_ti.trackers.replay import points_inside

__all__ = ["read_ply_points", "visible_points"]

PLY_TYPE_NAMES = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "i2": ("short", "int16"),
    "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"),
    "u4": ("uint", "uint32"),
    "f4": ("float", "float32"),
    "f8": ("double", "float64"),
}
PLY_TYPES = {name: code for code, names in PLY_TYPE_NAMES.items() for name in names}

# Visibility is judged in cells of this part of the image's longer side: in a cell, points up to this factor
# behind the nearest one are seen, those farther away are taken as hidden by it.
CELL = 1 / 60
HIDDEN_BEHIND = 1.15


def read_ply_points(path: Path) -> NDArray[np.float64]:
    """Positions (N, 3) of the vertices of a PLY file, ASCII or binary, without those that are not finite.

    Raises InputError for a file that is missing, damaged or without x, y and z.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    head, separator, body = data.partition(b"end_header")
    newline = body.find(b"\n")
    if not data.startswith(b"ply") or not separator or newline < 0:
        raise InputError(f"{path}: not a PLY file")
    form, count, properties = _header(head.decode("ascii", "replace").splitlines(), path)
    body = body[newline + 1 :]
    names = [name for name, _ in properties]
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"{path}: the vertices have no x, y and z")
    try:
        if form == "ascii":
            lines = body.decode("ascii").splitlines()
            rows = np.loadtxt(lines, max_rows=count, ndmin=2) if count and lines else np.zeros((0, len(names)))
            if len(rows) != count or rows.shape[1] < len(names):
                raise ValueError
            xyz = rows[:, [names.index(axis) for axis in "xyz"]]
        else:
            order = {"binary_little_endian": "<", "binary_big_endian": ">"}[form]
            record = np.dtype([(name, order + PLY_TYPES[kind]) for name, kind in properties])
            vertices = np.frombuffer(body, dtype=record, count=count)
            xyz = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    except (ValueError, KeyError, UnicodeDecodeError):
        raise InputError(f"{path}: the PLY file is damaged or cut off") from None
    return xyz[np.isfinite(xyz).all(axis=1)]


def _header(lines: list[str], path: Path) -> tuple[str, int, list[tuple[str, str]]]:
    """Format, number of vertices, and name and type of each vertex property."""
    form, count, element = "", 0, ""
    properties: list[tuple[str, str]] = []
    elements: list[str] = []
    for words in (line.split() for line in lines[1:]):
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) >= 2:
            form = words[1]
        elif words[0] == "element" and len(words) == 3 and words[2].isdigit():
            element = words[1]
            elements.append(element)
            count = int(words[2]) if element == "vertex" else count
        elif words[0] == "property" and element == "vertex":
            if len(words) != 3 or words[1] not in PLY_TYPES:
                raise InputError(f"{path}: vertices with `{' '.join(words)}` cannot be read")
            properties.append((words[2], words[1]))
    if not elements or elements[0] != "vertex":
        raise InputError(f"{path}: the first element of the PLY file must be `vertex`")
    return form, count, properties


def visible_points(
    xyz: NDArray[np.float64], undistorter: Undistorter, T_camera_world: NDArray[np.float64]
) -> SparsePoints:
    """The points (N, 3) of the world that project into the image and are not hidden behind nearer ones.

    Their pixels are their projections; their ids are their numbers in `xyz`.
    """
    camera = undistorter.camera
    in_camera = xyz @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    pixels = np.full((len(xyz), 2), np.nan)
    before = in_camera[:, 2] > 1e-9
    pixels[before] = camera.project(in_camera[before])
    points = points_inside(xyz, pixels, np.arange(len(xyz)), undistorter, T_camera_world)
    if len(points) == 0:
        return points

    depth = points.depths(T_camera_world)
    size = max(camera.width, camera.height) * CELL
    cell = (points.pixels // size).astype(np.int64)
    columns, rows = cell.max(axis=0) + 1
    nearest = np.full((rows, columns), np.inf)
    np.minimum.at(nearest, (cell[:, 1], cell[:, 0]), depth)
    seen = depth <= HIDDEN_BEHIND * nearest[cell[:, 1], cell[:, 0]]
    return SparsePoints(points.xyz[seen], points.pixels[seen], points.ids[seen])
