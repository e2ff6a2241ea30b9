"""Points without observations: read from a PLY file, and shown to each camera as far as it can see them."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints
from modp_ti.files import limited_lines, read_bytes
from modp_ti.files.errors import InputError
from modp_ti.files.ply import PlyHeader, parse_ply_header
from modp_ti.inputs.replay import FARTHEST, points_inside
from modp_ti.inputs.sources import Undistorter

__all__ = ["read_ply_points", "visible_points"]

# Visibility is judged in cells of this part of the image's longer side: in a cell, points up to this factor
# behind the nearest one are seen, those farther away are taken as hidden by it.
CELL = 1 / 60
HIDDEN_BEHIND = 1.15


def read_ply_points(path: Path) -> NDArray[np.float64]:
    """Positions (N, 3) of the vertices of a PLY file, ASCII or binary, without those that are not finite.

    Raises InputError for a file that is missing, damaged or without x, y and z.
    """
    try:
        data = read_bytes(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    header = parse_ply_header(data, path)
    if not set("xyz") <= set(header.names):
        raise InputError(f"{path}: the vertices have no x, y and z")
    places = [header.names.index(axis) for axis in "xyz"]
    xyz = np.empty((header.count, 3))
    try:
        if header.form == "ascii":
            for row, line in zip(xyz, _ascii_rows(data, header), strict=False):
                words = line.split()
                if len(words) < len(header.properties):
                    raise ValueError
                row[:] = [float(words[place]) for place in places]
        else:
            order = {"binary_little_endian": "<", "binary_big_endian": ">"}[header.form]
            record = np.dtype([(name, order + kind) for name, kind in header.properties])
            vertices = np.frombuffer(data, dtype=record, count=header.count, offset=header.start)
            with np.errstate(all="ignore"):  # a NaN that signals says so when it becomes a float64
                for column, axis in enumerate("xyz"):
                    xyz[:, column] = vertices[axis]
    except (ValueError, UnicodeDecodeError):
        raise InputError(f"{path}: the PLY file is damaged or cut off") from None
    return xyz[(np.abs(xyz) <= FARTHEST).all(axis=1)]


def _ascii_rows(data: bytes, header: PlyHeader) -> Iterator[str]:
    """The lines of the vertices. Raises ValueError where there are fewer of them."""
    with io.TextIOWrapper(io.BytesIO(data), encoding="ascii") as text:
        text.buffer.seek(header.start)
        rows = (line for line in limited_lines(text) if not line.isspace())
        for _ in range(header.count):
            line = next(rows, None)
            if line is None:
                raise ValueError
            yield line


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
