"""A capture: images whose cameras and poses, and often depth maps, come with them."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from modp_ti.files import LARGEST, reading
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import SETTING, FileTree
from modp_ti.files.trajectory import checked_pose, read_number_rows
from modp_ti.inputs.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.inputs.sources.image_header import read_image_header
from modp_ti.inputs.sources.undistortion import require_plausible

# From OpenGL camera axes (x right, y up, z back), which ARKit has, to OpenCV axes. The matrix is its own inverse.
OPENCV_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

LARGEST_TIME = 1e12  # [s]


@dataclass(frozen=True)
class DepthMap:
    """Depths that a sensor measured beside an image, over the same field of view.

    Attributes:
        metres: Depth (H, W) [m] along the optical axis; 0 where it is unknown.
        confident: Whether the sensor trusts each depth (H, W).
        camera: The sensor's camera; None for that of the image, at the size of the map.
    """

    metres: NDArray[np.float32]
    confident: NDArray[np.bool_]
    camera: PinholeCamera | None = None


@dataclass(frozen=True)
class CapturedFrame:
    """An image of a capture.

    Attributes:
        image: Name of the image in the source.
        time: Time at which it was taken [s].
        camera: Camera of the stored image.
        T_camera_world: Pose (4, 4), world to camera, OpenCV axes; None if the capture has none for it.
        lens: Lens distortion of the stored image.
        depth: Name of the file of its depth map; None if there is none.
        confidence: Name of the file of the depths' confidence; None if there is none.
    """

    image: str
    time: float
    camera: PinholeCamera
    T_camera_world: NDArray[np.float64] | None
    lens: Distortion = NO_DISTORTION
    depth: str | None = None
    confidence: str | None = None


@dataclass(frozen=True)
class Capture:
    """The images of a capture, in order.

    Attributes:
        tree: Its files.
        origin: Name of the file of the poses, for messages.
        frames: Its frames.
        notes: Remarks for the user.
        video: Name of the video that holds the images; empty if they are files.
        border: Width of the border of the images that shows nothing [px].
        read_depth: Reads the depth map of a frame that has one. Raises OSError or InputError.
    """

    tree: FileTree
    origin: str
    frames: Sequence[CapturedFrame]
    notes: Sequence[str] = field(default_factory=list)
    video: str = ""
    border: int = 0
    read_depth: Callable[[FileTree, CapturedFrame], DepthMap] | None = None


def rigid_motion(matrix: Any, where: str) -> NDArray[np.float64]:
    """Return a rigid motion (4, 4) that a file states, with the nearest rotation.

    Args:
        matrix: The numbers of a matrix (4, 4) or (3, 4), nested or in one row-major list.
        where: Start of the error message, such as file and line.

    Raises:
        InputError: If it is none.
    """
    try:
        numbers = np.array(matrix, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        numbers = np.zeros(0)
    if numbers.size not in (12, 16):
        raise InputError(f"{where}: the pose must be 12 or 16 numbers: 3 or 4 rows of a 4x4 matrix")
    numbers = numbers.reshape(-1, 4)
    if len(numbers) == 3:
        numbers = np.vstack([numbers, [0.0, 0.0, 0.0, 1.0]])
    return checked_pose(numbers, where)


def opencv_pose(matrix: Any, where: str) -> NDArray[np.float64]:
    """Return T_camera_world (4, 4) of a matrix, camera to world with OpenCV axes; see `rigid_motion`."""
    return inverse_se3(rigid_motion(matrix, where))


def opengl_pose(matrix: Any, where: str) -> NDArray[np.float64]:
    """Return T_camera_world (4, 4) of a matrix, camera to world with OpenGL axes; see `rigid_motion`."""
    return inverse_se3(rigid_motion(matrix, where) @ OPENCV_OPENGL)


def checked_numbers(values: Any, count: int, where: str) -> list[float]:
    """Return a list of `count` finite numbers. Raises InputError if the values are something else."""
    listed = values if isinstance(values, list) else [values]
    good = len(listed) == count and all(
        isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= LARGEST for value in listed
    )
    if not good:
        what = "a finite number" if count == 1 else f"{count} finite numbers"
        raise InputError(f"{where} must be {what}; the file is damaged")
    return [float(value) for value in listed]


def checked_time(value: Any, where: str) -> float:
    """Return a time [s]. Raises InputError if it is none."""
    (time,) = checked_numbers(value, 1, where)
    if abs(time) > LARGEST_TIME:
        raise InputError(f"{where} is no time in seconds: {time:g}; the file is damaged")
    return time


def plausible_camera(
    fx: float, fy: float, cx: float, cy: float, size: tuple[float, float], where: str, lens: Distortion = NO_DISTORTION
) -> PinholeCamera:
    """Return the camera of stored images of this size (width, height). Raises InputError if there is none such."""
    width, height = size
    if not (1 <= width <= 1 << 16 and 1 <= height <= 1 << 16 and width == int(width) and height == int(height)):
        raise InputError(f"{where}: images of {width:g}x{height:g} pixels are none; the file is damaged")
    if not (fx > 0 and fy > 0):
        raise InputError(f"{where}: focal lengths of {fx:g} and {fy:g} pixels are none; the file is damaged")
    camera, _ = require_plausible(PinholeCamera(fx, fy, cx, cy, int(width), int(height)), lens, where)
    return camera


def depth_files(tree: FileTree, depth: str, confidence: str) -> tuple[str | None, str | None]:
    """Return the names of a frame's depth map and of its confidence, None where there is none."""
    if not tree.has(depth):
        return None, None
    return depth, confidence if tree.has(confidence) else None


def size_of_pictures(tree: FileTree, names: Iterable[str]) -> tuple[int, int]:
    """Return the size (width, height) of the first picture whose header can be read.

    Raises:
        InputError: If there is none.
    """
    for name in names:
        with suppress(OSError):
            header = read_image_header(io.BytesIO(tree.read(name)))
            return header.width, header.height
    raise InputError(f"{tree.path}: holds no picture that can be read; copy it again")


def read_lines(tree: FileTree, name: str) -> list[tuple[int, str]]:
    """Read the lines of a text file that are neither blank nor comments, with their numbers from 1.

    Raises:
        InputError: If it cannot be read.
    """
    with reading(tree.path / name, SETTING):
        lines = enumerate((line.partition("#")[0].strip() for line in tree.read_text(name).splitlines()), 1)
    return [(number, line) for number, line in lines if line]


def read_numbers(tree: FileTree, name: str, columns: int, meaning: str, few: float = 0.0) -> NDArray[np.float64]:
    """Read rows (N, columns) of numbers, separated by blanks or commas; see `read_number_rows`.

    Raises:
        InputError: If the file cannot be read or has no rows; with the line, if a row is faulty.
    """
    with reading(tree.path / name, SETTING):
        text, least = tree.read_text(name).splitlines(), int(few < 1.0)
        return read_number_rows(
            tree.path / name, columns, meaning, "source.path", more=True, few=few, least=least, text=text
        ).values


def read_object(tree: FileTree, name: str, key: str) -> dict[str, Any]:
    """Read a JSON file that holds an object with this key.

    Raises:
        InputError: If it is missing or holds something else.
    """
    data = tree.read_json(name)
    if not isinstance(data, dict) or key not in data:
        raise InputError(f"{tree.path / name}: holds no `{key}`; the file is damaged, or of another program")
    return data


def numbered(tree: FileTree, folder: str, suffixes: tuple[str, ...]) -> dict[int, str]:
    """Return the names of the files in a folder that are called by a number, in its order."""
    found = {}
    for name in tree.listed(folder):
        path = PurePosixPath(name)
        if path.stem.isascii() and path.stem.isdecimal() and path.suffix.lower() in suffixes and len(path.stem) < 19:
            found.setdefault(int(path.stem), name)
    return dict(sorted(found.items()))
