"""COLMAP models, binary or text, as arrays. Every record is checked against the end of its file."""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import matrices_from_unit_quaternions
from modp_ti.files import input_lines, read_bytes, reading
from modp_ti.files.errors import InputError

# Name and number of parameters of each camera model, by its number in binary files.
CAMERA_MODELS = (
    *(("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8), ("OPENCV_FISHEYE", 8)),
    *(("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12)),
    *(("RAD_TAN_THIN_PRISM_FISHEYE", 16), ("SIMPLE_DIVISION", 4), ("DIVISION", 5), ("SIMPLE_FISHEYE", 3)),
    *(("FISHEYE", 4), ("EUCM", 6), ("EQUIRECTANGULAR", 2)),
)
STEMS = ("cameras", "images", "points3D")
OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])
# Longest line of a text model [characters]. All observations of an image are in one line.
MAX_TEXT_LINE = 1 << 24
MAX_LENGTH_ERROR = 0.1  # of a quaternion
AGAIN = "; copy or export the COLMAP model again"


@dataclass(frozen=True)
class ModelCamera:
    """A camera: the name of its model, its image size [px], and its parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ModelImage:
    """An image with a pose.

    Attributes:
        name: Its name.
        camera: Id of its camera.
        T_camera_world: Pose (4, 4), world to camera, as it is stated.
        pixels: Pixels (N, 2) of the points that it observes.
        ids: Ids (N,) of these points.
    """

    name: str
    camera: int
    T_camera_world: NDArray[np.float64]
    pixels: NDArray[np.float64]
    ids: NDArray[np.int64]


@dataclass(frozen=True)
class ColmapModel:
    """A model.

    Attributes:
        cameras: Cameras by id.
        images: Images by id.
        ids: Ids (P,) of the points, increasing.
        xyz: Their positions (P, 3), which may be NaN.
    """

    cameras: dict[int, ModelCamera]
    images: dict[int, ModelImage]
    ids: NDArray[np.int64]
    xyz: NDArray[np.float64]

    def positions(self, ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the positions (N, 3) of points by their ids (N,)."""
        return self.xyz[np.searchsorted(self.ids, ids)]


def read_colmap_model(folder: Path, posed_alone: bool = False) -> ColmapModel:
    """Read the binary or text model in a folder. Poses are those of the images; rigs and frames are not needed.

    Text is read as programs other than COLMAP write it too: with a byte-order mark, without the lines of images that
    observe nothing, with blanks in names.

    Args:
        folder: The folder.
        posed_alone: Whether the model may lack `points3D`. It then has no point.

    Raises:
        InputError: If the model is incomplete or damaged.
    """
    lacking = {s: {stem for stem in STEMS if not os.path.lexists(folder / f"{stem}{s}")} for s in (".bin", ".txt")}
    whole = [s for s in lacking if not lacking[s]]
    there = whole or [s for s in lacking if posed_alone and lacking[s] == {"points3D"}]
    if not there:
        missing = sorted(lacking[".bin"] & lacking[".txt"])
        raise InputError(f"{folder}: the COLMAP model lacks {', '.join(missing) or 'files of one format'}")
    readers = (_cameras, _images, _points) if there[0] == ".bin" else (_text_cameras, _text_images, _text_points)
    files = [folder / f"{stem}{there[0]}" for stem in STEMS]
    with reading(files[0], AGAIN):
        cameras = dict(readers[0](files[0]))
    with reading(files[1], AGAIN):
        images = dict(readers[1](files[1]))
    points, observers = {}, set[int]()
    with reading(files[2], AGAIN):
        for number, xyz, track in readers[2](files[2]) if whole else ():
            points[number] = xyz
            observers.update(track)
    ids = np.array(sorted(points), dtype=np.int64)
    for image in images.values():
        if image.camera not in cameras:
            raise InputError(f"{files[0]}: lacks camera {image.camera} of image {image.name}{AGAIN}")
        if not np.isin(image.ids, ids).all() and whole:
            raise InputError(f"{files[2]}: is incomplete: image {image.name} observes points that it lacks{AGAIN}")
    if observers - images.keys() and any(len(image.ids) for image in images.values()):
        raise InputError(f"{files[1]}: is incomplete: it lacks images that observe points{AGAIN}")
    return ColmapModel(cameras, images, ids, np.array([points[i] for i in ids.tolist()]).reshape(-1, 3))


def image_count(folder: Path) -> int:
    """Return the number of images of a model, 0 if there is none that can be read."""
    try:
        if (folder / "images.bin").exists():
            return _Cursor(folder / "images.bin").read("<Q")[0]
        return sum(1 for _ in _text_images(folder / "images.txt"))
    except (InputError, ValueError, IndexError):
        return 0


def _image(
    pose: Sequence[float], camera: int, name: str, pixels: NDArray[np.float64], ids: NDArray[np.int64]
) -> ModelImage:
    """Return the image with this pose, a quaternion and a translation. Observations of no point are left out."""
    length = math.hypot(*pose[:4])
    if not abs(length - 1.0) < MAX_LENGTH_ERROR:
        raise ValueError(f"the quaternion of {name} has length {length:.4g} instead of 1")
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3] = matrices_from_unit_quaternions(np.array(pose[:4]))
    T_camera_world[:3, 3] = pose[4:]
    seen = ids >= 0
    return ModelImage(name, camera, T_camera_world, pixels[seen], ids[seen])


class _Cursor:
    """A position in a file. Moving it beyond the end raises InputError."""

    def __init__(self, file: Path) -> None:
        self.data = read_bytes(file)
        self.file = file
        self.at = 0

    def skip(self, size: int) -> int:
        """Move on by so many bytes, and return the position before."""
        before, self.at = self.at, self.at + size
        if self.at > len(self.data):
            raise InputError(f"{self.file}: the file is cut off{AGAIN}")
        return before

    def read(self, form: str) -> tuple[Any, ...]:
        return struct.unpack_from(form, self.data, self.skip(struct.calcsize(form)))

    def records(self) -> Iterator[int]:
        """Yield the numbers of the records. The file must end where they end."""
        yield from range(self.read("<Q")[0])
        if self.at != len(self.data):
            raise InputError(f"{self.file}: {len(self.data) - self.at} bytes too long{AGAIN}")


def _cameras(file: Path) -> Iterator[tuple[int, ModelCamera]]:
    cursor = _Cursor(file)
    for _ in cursor.records():
        number, model, width, height = cursor.read("<IiQQ")
        if not 0 <= model < len(CAMERA_MODELS):
            raise InputError(f"{file}: camera model number {model} is not known; the file is damaged or too new")
        name, count = CAMERA_MODELS[model]
        yield number, ModelCamera(name, width, height, cursor.read(f"<{count}d"))


def _images(file: Path) -> Iterator[tuple[int, ModelImage]]:
    cursor = _Cursor(file)
    for _ in cursor.records():
        number, *pose, camera = cursor.read("<I7dI")
        end = cursor.data.find(b"\0", cursor.at)  # of the name
        start = cursor.skip((len(cursor.data) if end < 0 else end) + 1 - cursor.at)
        name = cursor.data[start:end].decode()
        (count,) = cursor.read("<Q")
        seen = np.frombuffer(cursor.data, OBSERVATION, count, cursor.skip(count * OBSERVATION.itemsize))
        yield number, _image(pose, camera, name, seen["pixel"], seen["point"])


def _points(file: Path) -> Iterator[tuple[int, tuple[float, ...], Sequence[int]]]:
    cursor = _Cursor(file)
    for _ in cursor.records():
        number, *xyz, count = cursor.read("<q3d3x8xQ")  # id, position, colour, error, length of the track
        cursor.skip(count * 8)  # image, observation
        yield number, tuple(xyz), ()  # the ends of binary files are checked


def _text_cameras(file: Path) -> Iterator[tuple[int, ModelCamera]]:
    for line in _lines(file):
        number, model, width, height, *params = line.split()
        camera = ModelCamera(model, int(width), int(height), tuple(map(float, params)))
        if len(params) != dict(CAMERA_MODELS).get(model, len(params)):
            raise InputError(f"{file}: camera {number} has {len(params)} parameters, which {model} has not{AGAIN}")
        yield int(number), camera


def _text_images(file: Path) -> Iterator[tuple[int, ModelImage]]:
    """Yield the images. A line of observations may be missing, and blank lines may stand anywhere."""
    lines = list(_lines(file))
    at = 0
    while at < len(lines):
        number, *pose, camera, name = lines[at].split(maxsplit=9)
        observed = _observations(lines[at + 1]) if at + 1 < len(lines) else None
        at += 1 if observed is None else 2
        rows = np.zeros((0, 3)) if observed is None else observed
        yield int(number), _image([*map(float, pose)], int(camera), name, rows[:, :2], rows[:, 2].astype(np.int64))


def _observations(line: str) -> NDArray[np.float64] | None:
    """Return the triples (N, 3) of numbers of a line; None if it is one of an image, which has a name."""
    try:
        return np.array(line.split(), dtype=np.float64).reshape(-1, 3)
    except ValueError:
        return None


def _text_points(file: Path) -> Iterator[tuple[int, tuple[float, ...], Sequence[int]]]:
    for line in _lines(file):
        number, x, y, z, _, _, _, _, *track = line.split()
        yield int(number), (float(x), float(y), float(z)), [*map(int, track[::2])]


def _lines(file: Path) -> Iterator[str]:
    """Yield the lines of a text file that are neither blank nor comments."""
    for line in input_lines(file, AGAIN, MAX_TEXT_LINE):
        if (line := line.strip()) and not line.startswith("#"):
            yield line
