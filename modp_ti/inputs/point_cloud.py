"""Points without observations: reading from files, and a visibility test per camera."""

from __future__ import annotations

import io
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints
from modp_ti.files import open_file, read_bytes, reading
from modp_ti.files.errors import InputError
from modp_ti.files.ply import parse_ply_header
from modp_ti.files.trajectory import FARTHEST, read_number_rows
from modp_ti.inputs.replay import PosedImage, points_inside
from modp_ti.inputs.sources import Undistorter

# Longest header of a PCD file [bytes].
PCD_START = 4096

# Visibility is decided per square cell, whose size is this share of the image's longer side. In a cell, points up to
# this factor of the nearest depth are visible; those farther away count as hidden.
CELL = 1 / 60
HIDDEN_BEHIND = 1.15


def read_point_file(path: Path) -> NDArray[np.float64]:
    """Read positions (N, 3) from a PLY, PCD or NPY file, or from text whose lines begin with `x y z`.

    Positions that are not finite or lie beyond `FARTHEST` are dropped.

    Raises:
        InputError: If the file is none of these or has no points. For text, the message names the line.
    """
    with reading(path, " (tracker.points)"), open_file(path) as file:
        start = file.read(PCD_START)
    if start.startswith(b"ply"):
        xyz = read_ply_points(path)
    elif start.startswith(b"\x93NUMPY"):
        xyz = read_npy_points(path)
    elif b"\nDATA " in start:
        xyz = _read_pcd(path)
    else:
        xyz = read_number_rows(path, 3, "x y z", "tracker.points", more=True, few=1.0).values
    xyz = xyz[(np.abs(xyz) <= FARTHEST).all(axis=1)]
    if len(xyz) == 0:
        raise InputError(f"{path}: holds no point (tracker.points); leave the key out to have points triangulated")
    return xyz


def read_ply_points(path: Path) -> NDArray[np.float64]:
    """Read the vertex positions (N, 3) of an ASCII or binary PLY file.

    Positions that are not finite or lie beyond `FARTHEST` are dropped.

    Raises:
        InputError: If the file is missing, damaged, or lacks x, y and z.
    """
    with reading(path):
        data = read_bytes(path)
    header = parse_ply_header(data, path)
    if not set("xyz") <= set(header.names):
        raise InputError(f"{path}: the vertices have no x, y and z")
    with reading(path), np.errstate(all="ignore"):  # converting a signalling NaN to float64 warns
        if header.form == "ascii":
            lines = data[header.start :].decode("ascii").splitlines()
            rows = list(islice((line for line in lines if line.strip()), header.count))
            if len(rows) < header.count or any(len(row.split()) < len(header.properties) for row in rows[-1:]):
                raise InputError(f"{path}: the PLY file is damaged or cut off")
            places = [header.names.index(axis) for axis in "xyz"]
            xyz = np.loadtxt(rows, usecols=places, ndmin=2) if rows else np.zeros((0, 3))
        else:
            order = "<" if header.form == "binary_little_endian" else ">"
            record = np.dtype([(name, order + kind) for name, kind in header.properties])
            vertices = np.frombuffer(data, dtype=record, count=header.count, offset=header.start)
            xyz = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    return xyz[(np.abs(xyz) <= FARTHEST).all(axis=1)]


def read_npy_points(path: Path) -> NDArray[np.float64]:
    """Read the first three columns (N, 3) of an array that np.save has written.

    Raises:
        InputError: If the file is damaged, or its array is none of points.
    """
    with reading(path):
        xyz = np.load(io.BytesIO(read_bytes(path)), allow_pickle=False)
    if xyz.ndim != 2 or xyz.shape[1] < 3 or xyz.dtype.kind not in "fiu":
        raise InputError(f"{path}: holds an array of shape {xyz.shape} and type {xyz.dtype} instead of (N, 3) numbers")
    with np.errstate(all="ignore"):  # converting a signalling NaN to float64 warns
        xyz = np.array(xyz[:, :3], dtype=np.float64)
    return xyz


def _read_pcd(path: Path) -> NDArray[np.float64]:
    """Read the positions (N, 3) of a PCD file, ASCII or binary."""
    data = read_bytes(path)
    form, _, content = data.partition(b"\nDATA ")[2].partition(b"\n")
    lines = [line.split() for line in data[: data.find(b"\nDATA ")].decode("ascii", "replace").splitlines()]
    header = {words[0]: words[1:] for words in lines if words}
    if form.strip() == b"binary_compressed":
        raise InputError(f"{path}: a compressed PCD file: save it as binary or ASCII (pcl_convert_pcd_ascii_binary)")
    with reading(path, " (tracker.points)"):
        names, count = header["FIELDS"], int(header["POINTS"][0])
        repeats = [int(n) for n in header.get("COUNT", ["1"] * len(names))]
        if form.strip() == b"ascii":
            places = [sum(repeats[: names.index(axis)]) for axis in "xyz"]
            rows = [line.split() for line in content.decode("ascii").splitlines() if line.strip()]
            return np.array([[float(row[place]) for place in places] for row in rows[:count]]).reshape(count, 3)
        kinds = [f"<{kind.lower()}{size}" for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
        fields = zip(names, kinds, repeats, strict=True)
        record = np.dtype([(f"{name} {n}", kind, (many,)) for n, (name, kind, many) in enumerate(fields)])
        table = np.frombuffer(content, record, count)
        return np.stack([table[f"{axis} {names.index(axis)}"][:, 0] for axis in "xyz"], axis=1).astype(np.float64)


def projected_points(
    xyz: NDArray[np.float64], ids: NDArray[np.int64], undistorter: Undistorter, T_camera_world: NDArray[np.float64]
) -> SparsePoints:
    """Return the points in front of the camera that project into the image, with their projections as pixels."""
    in_camera = xyz @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    pixels = np.full((len(xyz), 2), np.nan)
    before = in_camera[:, 2] > 1e-9
    pixels[before] = undistorter.camera.project(in_camera[before])
    return points_inside(xyz, pixels, ids, undistorter, T_camera_world)


def visible_points(
    xyz: NDArray[np.float64], undistorter: Undistorter, T_camera_world: NDArray[np.float64]
) -> SparsePoints:
    """Return the points that project into the image and are not hidden behind nearer ones.

    Args:
        xyz: World points (N, 3).
        undistorter: Holds the camera of the delivered image.
        T_camera_world: Pose (4, 4), world to camera.

    Returns:
        The visible points, with their projections as pixels and their row in `xyz` as id.
    """
    camera = undistorter.camera
    points = projected_points(xyz, np.arange(len(xyz)), undistorter, T_camera_world)
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


def spread_points(xyz: NDArray[np.float64], numbers: NDArray[np.int64], frame: PosedImage, limit: int) -> SparsePoints:
    """Select the visible points of a frame, at most `limit` of them.

    The random choice is the same for all frames, so that frames of the same place keep the same points.

    Args:
        xyz: World points (N, 3).
        numbers: Their ids (N,).
        frame: The frame.
        limit: Largest number of points.
    """
    points = visible_points(xyz, frame.undistorter, frame.T_camera_world)
    ids = numbers[points.ids]
    if len(points) <= limit:
        return SparsePoints(points.xyz, points.pixels, ids)
    # splitmix64, a bijection on 64-bit numbers, defines one random order of all ids.
    order = ids.astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
    order = (order ^ (order >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    order = (order ^ (order >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    kept = np.sort(np.argsort(order ^ (order >> np.uint64(31)), kind="stable")[:limit])
    return SparsePoints(points.xyz[kept], points.pixels[kept], ids[kept])
