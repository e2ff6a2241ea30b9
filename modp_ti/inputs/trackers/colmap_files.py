"""Reading of COLMAP models, with a check of the file structure before pycolmap reads them.

pycolmap does not detect the end of a file. In a truncated model it takes counts and numbers from uninitialised memory,
which gives wrong cameras or allocates gigabytes. Walking over all records first and ending exactly at the end of the
file rules that out.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from modp_ti.files import input_lines, read_bytes, readable
from modp_ti.files.errors import InputError

if TYPE_CHECKING:
    from modp_ti.files.quiet_pycolmap import pycolmap

__all__ = ["read_colmap_model"]

# Number of parameters of each camera model, by COLMAP's model id.
CAMERA_PARAMS = dict(enumerate((3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)))

STEMS = ("cameras", "images", "points3D")
# Longest line of a text model [characters]. All observations of an image are in one line.
MAX_TEXT_LINE = 1 << 24


def read_colmap_model(folder: Path) -> pycolmap.Reconstruction:
    """Read the binary or text model in a folder.

    Raises:
        InputError: If the model is incomplete or damaged.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    lacking = {s: {stem for stem in STEMS if not (folder / f"{stem}{s}").exists()} for s in (".bin", ".txt")}
    if not lacking[".bin"]:
        _require_whole_binary_model(folder)
    elif not lacking[".txt"]:
        _require_text_model(folder)
    else:
        missing = sorted(lacking[".bin"] & lacking[".txt"])
        raise InputError(f"{folder}: the COLMAP model lacks {', '.join(missing) or 'files of one format'}")
    try:
        model = pycolmap.Reconstruction(str(folder))
        for image in model.images.values():
            image.name.encode()  # fails if the name in the file is not UTF-8
    except Exception as error:  # from C++: ValueError, IndexError, MemoryError or RuntimeError
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{folder}: not a readable COLMAP model ({reason}); export it again") from None
    return model


def _require_text_model(folder: Path) -> None:
    """Raise InputError if a .txt file of the model is not text or an image's quaternion is invalid."""
    for file in filter(Path.exists, (folder / f"{stem}.txt" for stem in RECORDS)):
        lines = input_lines(file, "; export the COLMAP model again", MAX_TEXT_LINE)
        for line in lines:
            words = line.split(maxsplit=5)
            if file.stem == "images" and words and not words[0].startswith("#"):
                try:
                    _require_quaternion(file, [float(word) for word in words[1:5]])
                except ValueError as error:
                    raise InputError(f"{file}: {error!s:.80}; the file is damaged") from None
                next(lines, None)  # the image's observations


def _require_quaternion(file: Path, q: Sequence[float]) -> None:
    """Raise InputError if a quaternion is not of unit length. COLMAP would normalise it silently."""
    length = math.hypot(*q)
    if not 0.9 < length < 1.1:
        raise InputError(
            f"{file}: the quaternion of an image has length {length:.4g} instead of 1; the file is damaged"
        )


class _Cursor:
    """A position in a file. Moving it beyond the end raises InputError."""

    def __init__(self, file: Path) -> None:
        with readable(file):
            self.data = read_bytes(file)
        self.file = file
        self.at = 0

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise InputError(f"{self.file}: the file is cut off; copy or export the COLMAP model again")

    def read(self, form: str) -> tuple[Any, ...]:
        size = struct.calcsize(form)
        self.skip(size)
        return struct.unpack_from(form, self.data, self.at - size)

    def skip_list(self, count: str, size: int) -> None:
        """Skip items of this size and, before them, their number in the format `count`."""
        self.skip(size * self.read(count)[0])


def _camera(cursor: _Cursor) -> None:
    (model,) = cursor.read("<4xi16x")  # id, model, width, height
    if model not in CAMERA_PARAMS:
        raise InputError(
            f"{cursor.file}: camera model number {model} is not known; the file is damaged or of a newer COLMAP"
        )
    cursor.skip(8 * CAMERA_PARAMS[model])


def _image(cursor: _Cursor) -> None:
    _require_quaternion(cursor.file, cursor.read("<4x4d28x"))  # id, quaternion, position, camera
    end = cursor.data.find(b"\0", cursor.at)  # of the name
    cursor.skip((len(cursor.data) if end < 0 else end) + 1 - cursor.at)
    cursor.skip_list("<Q", 24)  # x, y, point


def _point(cursor: _Cursor) -> None:
    cursor.skip(8 + 3 * 8 + 3 + 8)  # id, position, colour, error
    cursor.skip_list("<Q", 8)  # image, observation


def _rig(cursor: _Cursor) -> None:
    (sensors,) = cursor.read("<4xI")  # id, number of sensors
    if sensors > 0:
        cursor.skip(8)  # the reference sensor has no pose
    for _ in range(sensors - 1):
        if cursor.read("<8xB")[0]:
            cursor.skip(7 * 8)


def _frame(cursor: _Cursor) -> None:
    cursor.skip(4 + 4 + 7 * 8)  # id, rig, pose
    cursor.skip_list("<I", 16)  # sensor type, sensor, data


RECORDS: dict[str, Callable[[_Cursor], None]] = {
    "cameras": _camera,
    "images": _image,
    "points3D": _point,
    "rigs": _rig,
    "frames": _frame,
}


def _require_whole_binary_model(folder: Path) -> None:
    """Raise InputError if a .bin file of the model is truncated, damaged or followed by other data."""
    for stem, skip_record in RECORDS.items():
        file = folder / f"{stem}.bin"
        if not file.exists():
            continue
        cursor = _Cursor(file)
        for _ in range(cursor.read("<Q")[0]):
            skip_record(cursor)
        if cursor.at != len(cursor.data):
            raise InputError(f"{file}: {len(cursor.data) - cursor.at} bytes too long; export the COLMAP model again")
