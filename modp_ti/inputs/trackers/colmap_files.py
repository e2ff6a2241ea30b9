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

    if not any(all((folder / f"{stem}{suffix}").exists() for stem in STEMS) for suffix in (".bin", ".txt")):
        missing = [stem for stem in STEMS if not any((folder / f"{stem}{s}").exists() for s in (".bin", ".txt"))]
        raise InputError(f"{folder}: the COLMAP model lacks {', '.join(missing) or 'files of one format'}")
    if all((folder / f"{stem}.bin").exists() for stem in STEMS):
        _require_whole_binary_model(folder)
    else:
        _require_text_model(folder)
    try:
        model = pycolmap.Reconstruction(str(folder))
        for image in model.images.values():
            image.name.encode()  # fails if the name in the file is not UTF-8
    except Exception as error:  # from C++: ValueError, IndexError, MemoryError or RuntimeError
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{folder}: not a readable COLMAP model ({reason}); export it again") from None
    return model


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise _DamagedError(f"{word[:40]!r} stands where a number should") from None


def _require_text_model(folder: Path) -> None:
    """Raise InputError if a .txt file of the model is not text or an image's quaternion is invalid."""
    for stem in RECORDS:
        file = folder / f"{stem}.txt"
        if not file.exists():
            continue
        try:
            lines = input_lines(file, "; export the COLMAP model again", MAX_TEXT_LINE)
            for line in lines:
                words = line.split(maxsplit=5)
                if stem == "images" and words and not words[0].startswith("#"):
                    _require_quaternion([_number(word) for word in words[1:5]])
                    next(lines, None)  # the image's observations
        except _DamagedError as error:
            raise InputError(f"{file}: {error}; the file is damaged") from None


class _CutOffError(Exception):
    """A record extends beyond the end of the file."""


class _DamagedError(Exception):
    """A record contains values that COLMAP never writes."""


class _Cursor:
    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise _CutOffError

    def read(self, form: str) -> tuple[Any, ...]:
        size = struct.calcsize(form)
        self.skip(size)
        return struct.unpack_from(form, self.data, self.at - size)

    def skip_text(self) -> None:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise _CutOffError
        self.at = end + 1


def _require_quaternion(q: Sequence[float]) -> None:
    """Raise _DamagedError if a quaternion is not of unit length. COLMAP would normalise it silently."""
    length = math.hypot(*q)
    if not 0.9 < length < 1.1:
        raise _DamagedError(f"the quaternion of an image has length {length:.4g} instead of 1")


def _camera(cursor: _Cursor) -> None:
    cursor.skip(4)  # id
    (model,) = cursor.read("<i")
    cursor.skip(16)  # width, height
    if model not in CAMERA_PARAMS:
        raise _DamagedError(f"camera model number {model} is not known")
    cursor.skip(8 * CAMERA_PARAMS[model])


def _image(cursor: _Cursor) -> None:
    cursor.skip(4)  # id
    _require_quaternion(cursor.read("<4d"))
    cursor.skip(3 * 8 + 4)  # position, camera
    cursor.skip_text()
    cursor.skip(24 * cursor.read("<Q")[0])  # x, y, point


def _point(cursor: _Cursor) -> None:
    cursor.skip(8 + 3 * 8 + 3 + 8)  # id, position, colour, error
    cursor.skip(8 * cursor.read("<Q")[0])  # image, observation


def _rig(cursor: _Cursor) -> None:
    cursor.skip(4)  # id
    (sensors,) = cursor.read("<I")
    if sensors > 0:
        cursor.skip(8)  # the reference sensor has no pose
    for _ in range(sensors - 1):
        cursor.skip(8)
        if cursor.read("<B")[0]:
            cursor.skip(7 * 8)


def _frame(cursor: _Cursor) -> None:
    cursor.skip(4 + 4 + 7 * 8)  # id, rig, pose
    cursor.skip(16 * cursor.read("<I")[0])  # sensor type, sensor, data


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
        with readable(file):
            cursor = _Cursor(read_bytes(file))
        try:
            for _ in range(cursor.read("<Q")[0]):
                skip_record(cursor)
        except _CutOffError:
            raise InputError(f"{file}: the file is cut off; copy or export the COLMAP model again") from None
        except _DamagedError as error:
            raise InputError(f"{file}: {error}; the file is damaged or of a newer COLMAP") from None
        if cursor.at != len(cursor.data):
            raise InputError(f"{file}: {len(cursor.data) - cursor.at} bytes too long; export the COLMAP model again")
