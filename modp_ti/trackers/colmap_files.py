"""Structure of COLMAP's binary files, checked before pycolmap reads them.

pycolmap does not notice the end of a file: of a model that was cut off it takes whatever the memory held for
counts and numbers, which ends in wrong cameras or in gigabytes of allocation. Walking the records and meeting
the end exactly rules that out.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from modp_ti.errors import InputError

__all__ = ["require_whole_binary_model"]

# Parameters of each camera model, by COLMAP's model number.
CAMERA_PARAMS = dict(enumerate((3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)))


class _CutOffError(Exception):
    """A record goes on behind the end of the file."""


class _DamagedError(Exception):
    """A record holds what no COLMAP writes."""


class _Cursor:
    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise _CutOffError

    def read(self, form: str) -> int:
        size = struct.calcsize(form)
        self.skip(size)
        return int(struct.unpack_from(form, self.data, self.at - size)[0])

    def skip_text(self) -> None:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise _CutOffError
        self.at = end + 1


def _camera(cursor: _Cursor) -> None:
    cursor.skip(4)  # id
    model = cursor.read("<i")
    cursor.skip(16)  # width, height
    if model not in CAMERA_PARAMS:
        raise _DamagedError(f"camera model number {model} is not known")
    cursor.skip(8 * CAMERA_PARAMS[model])


def _image(cursor: _Cursor) -> None:
    cursor.skip(4 + 7 * 8 + 4)  # id, pose, camera
    cursor.skip_text()
    cursor.skip(24 * cursor.read("<Q"))  # x, y, point


def _point(cursor: _Cursor) -> None:
    cursor.skip(8 + 3 * 8 + 3 + 8)  # id, position, colour, error
    cursor.skip(8 * cursor.read("<Q"))  # image, observation


def _rig(cursor: _Cursor) -> None:
    cursor.skip(4)  # id
    sensors = cursor.read("<I")
    if sensors > 0:
        cursor.skip(8)  # the reference sensor has no pose
    for _ in range(sensors - 1):
        cursor.skip(8)
        if cursor.read("<B"):
            cursor.skip(7 * 8)


def _frame(cursor: _Cursor) -> None:
    cursor.skip(4 + 4 + 7 * 8)  # id, rig, pose
    cursor.skip(16 * cursor.read("<I"))  # sensor type, sensor, data


RECORDS: dict[str, Callable[[_Cursor], None]] = {
    "cameras": _camera,
    "images": _image,
    "points3D": _point,
    "rigs": _rig,
    "frames": _frame,
}


def require_whole_binary_model(folder: Path) -> None:
    """Raises InputError where a .bin file of the model is cut off, damaged or followed by other data."""
    for stem, skip_record in RECORDS.items():
        file = folder / f"{stem}.bin"
        if not file.exists():
            continue
        try:
            cursor = _Cursor(file.read_bytes())
        except OSError as error:
            raise InputError(f"{file}: cannot be read: {error.strerror}") from None
        try:
            for _ in range(cursor.read("<Q")):
                skip_record(cursor)
        except _CutOffError:
            raise InputError(f"{file}: the file is cut off; copy or export the COLMAP model again") from None
        except _DamagedError as error:
            raise InputError(f"{file}: {error}; the file is damaged or of a newer COLMAP") from None
        if cursor.at != len(cursor.data):
            raise InputError(f"{file}: {len(cursor.data) - cursor.at} bytes too long; export the COLMAP model again")
