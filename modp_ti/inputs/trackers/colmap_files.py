"""Reading of COLMAP models, with a check of the file structure before pycolmap reads them.

pycolmap does not detect the end of a file. In a truncated model it takes counts and numbers from uninitialised memory,
which gives wrong cameras or allocates gigabytes. Walking over all records first and ending exactly at the end of the
file rules that out.
"""

from __future__ import annotations

import math
import os
import shutil
import struct
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from modp_ti.files import input_lines, read_bytes, readable
from modp_ti.files.errors import InputError

if TYPE_CHECKING:
    from modp_ti.files.quiet_pycolmap import pycolmap

__all__ = ["image_count", "read_colmap_model"]

# Number of parameters of each camera model, by COLMAP's model id.
CAMERA_PARAMS = dict(enumerate((3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)))

STEMS = ("cameras", "images", "points3D")
# Longest line of a text model [characters]. All observations of an image are in one line.
MAX_TEXT_LINE = 1 << 24
# Written for coordinates that are not finite, which pycolmap does not read. It lies beyond FARTHEST.
NOWHERE = "1e300"


def read_colmap_model(folder: Path, posed_alone: bool = False) -> pycolmap.Reconstruction:
    """Read the binary or text model in a folder.

    Text is read as programs other than COLMAP write it too: with a byte-order mark, without the lines of images that
    observe nothing, with blanks in names. NaN becomes a coordinate beyond `FARTHEST`.

    Args:
        folder: The folder.
        posed_alone: Whether the model may lack `points3D`. It then has no point.

    Raises:
        InputError: If the model is incomplete or damaged.
    """
    lacking = {s: {stem for stem in STEMS if not os.path.lexists(folder / f"{stem}{s}")} for s in (".bin", ".txt")}
    there = [s for s in lacking if not lacking[s]]
    if posed_alone:
        there += [s for s in lacking if lacking[s] == {"points3D"}]
    if not there:
        missing = sorted(lacking[".bin"] & lacking[".txt"])
        raise InputError(f"{folder}: the COLMAP model lacks {', '.join(missing) or 'files of one format'}")
    if there[0] == ".bin":
        _require_whole_binary_model(folder)
        if not lacking[".bin"]:
            return _read(folder, folder)
    with tempfile.TemporaryDirectory(prefix="modp-ti-colmap-") as plain:
        if there[0] == ".txt":
            return _read(folder, Path(plain), _write_plain_text(folder, Path(plain)))
        for file in folder.glob("*.bin"):
            shutil.copyfile(file, Path(plain) / file.name)
        (Path(plain) / "points3D.bin").write_bytes(bytes(8))
        return _read(folder, Path(plain))


def image_count(folder: Path) -> int:
    """Return the number of images of a model, 0 if there is none that can be read."""
    try:
        if (folder / "images.bin").exists():
            return _Cursor(folder / "images.bin").read("<Q")[0]
        return sum(1 for _ in _images_of_text(folder / "images.txt"))
    except InputError:
        return 0


def _read(folder: Path, plain: Path, names: Mapping[int, str] | None = None) -> pycolmap.Reconstruction:
    """Read the model in `plain`, which is that of `folder`, and give its images these names."""
    from modp_ti.files.quiet_pycolmap import pycolmap

    try:
        model = pycolmap.Reconstruction(str(plain))
        for number, name in (names or {}).items():
            model.images[number].name = name
        for image in model.images.values():
            image.name.encode()  # fails if the name in the file is not UTF-8
    except Exception as error:  # from C++: ValueError, IndexError, MemoryError or RuntimeError
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{folder}: not a readable COLMAP model ({reason}); export it again") from None
    return model


def _write_plain_text(folder: Path, plain: Path) -> dict[int, str]:
    """Write a text model as pycolmap reads it, and return the names of its images, which are numbers there."""
    names: dict[int, str] = {}
    observing = False
    with (plain / "images.txt").open("w", encoding="utf-8") as file:
        for words, observed in _images_of_text(folder / "images.txt"):
            names[int(words[0])] = words[9]
            observing |= bool(observed)
            file.write(f"{' '.join(words[:9])} {words[0]}\n{observed}\n")
    with (plain / "points3D.txt").open("w", encoding="utf-8") as file:
        points = folder / "points3D.txt"
        for number, line in _lines(points) if points.exists() else ():
            words = line.split(maxsplit=8)
            try:
                xyz = [word if math.isfinite(float(word)) else NOWHERE for word in words[1:4]]
                track = words[8:] if observing else []
                file.write(" ".join([words[0], *xyz, words[4], words[5], words[6], words[7], *track]) + "\n")
            except (ValueError, IndexError):
                raise InputError(
                    f"{points}:{number}: no line of a point (id x y z r g b error); export the model again"
                ) from None
    for stem in ("cameras", "rigs", "frames"):
        if (folder / f"{stem}.txt").exists():
            text = "\n".join(line for _, line in _lines(folder / f"{stem}.txt"))
            (plain / f"{stem}.txt").write_text(text + "\n", encoding="utf-8")
    return names


def _images_of_text(file: Path) -> Iterator[tuple[list[str], str]]:
    """Yield the ten words of each image in images.txt, the last of them its name, and the line of its observations.

    A line of observations holds triples of numbers. It may be missing, and blank lines may stand anywhere.
    """
    image: list[str] | None = None
    for number, line in _lines(file):
        words = line.split(maxsplit=9)
        if image is not None and _are_observations(line):
            yield image, line
            image = None
            continue
        if image is not None:
            yield image, ""
        try:
            _require_quaternion(file, [float(word) for word in words[1:5]])
            _ = int(words[0]), [float(word) for word in words[5:8]], int(words[8]), words[9]
        except (ValueError, IndexError):
            raise InputError(
                f"{file}:{number}: no line of an image (id qw qx qy qz tx ty tz camera name); the file is damaged"
            ) from None
        image = words
    if image is not None:
        yield image, ""


def _are_observations(line: str) -> bool:
    """Whether a line holds triples of numbers and not an image, whose tenth word is the start of a name."""
    words = line.split()
    try:
        [float(word) for word in words[:10]]
    except ValueError:
        return False
    return len(words) % 3 == 0


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Yield number and content of the lines of a text file that are neither blank nor comments."""
    for number, line in enumerate(input_lines(file, "; export the COLMAP model again", MAX_TEXT_LINE), 1):
        if (line := line.strip()) and not line.startswith("#"):
            yield number, line


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
