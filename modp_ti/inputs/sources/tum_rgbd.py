"""Source `tum_rgbd`: a sequence of the TUM RGB-D benchmark, whose images and times are listed in `rgb.txt`."""

from __future__ import annotations

import math
import re
from pathlib import Path

from fields.geometry.camera import PinholeCamera
from modp_ti.files import LARGEST, input_lines, is_file
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.listed_images import ListedImages

__all__ = ["open_tum_rgbd", "read_listing"]

WIDTH, HEIGHT = 640, 480
HINT = "; it should list the images (source.path)"

# Published calibrations of the benchmark's three cameras: fx, fy, cx, cy with pixel centres at whole numbers, and the
# lens. The images of the third camera are already undistorted.
CAMERAS = {
    1: (517.3, 516.5, 318.6, 255.3, Distortion((0.2624, -0.9531, 1.1633), tangential=(-0.0054, 0.0026))),
    2: (520.9, 521.0, 325.1, 249.7, Distortion((0.2312, -0.7849, 0.9172), tangential=(-0.0033, -0.0001))),
    3: (535.4, 539.2, 320.1, 247.6, NO_DISTORTION),
}
CAMERA_NAME = re.compile(r"(?:freiburg|fr)[-_ ]?([123])(?![0-9])", re.IGNORECASE)


def open_tum_rgbd(path: Path) -> ListedImages:
    """Open the images that `rgb.txt` lists and that exist, with the times of the listing.

    Args:
        path: Folder of the sequence.

    Raises:
        InputError: If the listing is missing, malformed or unordered (the message names the line), or no listed image
            exists.
    """
    listing = path / "rgb.txt"
    entries = read_listing(listing)
    there = [(time, name) for time, name in entries if is_file(path / name)]
    if not there:
        raise InputError(
            f"{listing}: none of its {len(entries)} images is there, the first is {entries[0][1]}: "
            "unpack the whole sequence, or correct the listing"
        )
    notes = []
    if len(there) < len(entries):
        notes.append(f"{len(entries) - len(there)} of the {len(entries)} images that {listing} lists are not there")
    comments = (line for line in input_lines(listing, HINT) if line.startswith("#"))
    named = CAMERA_NAME.search(path.resolve().name)
    found = named or next(filter(None, map(CAMERA_NAME.search, comments)), None)
    if found is None:
        intrinsics = None
        notes.append(
            f"{path} names none of the benchmark's cameras (freiburg1, freiburg2, freiburg3 or fr1, fr2, fr3): "
            "give source.intrinsics where the tracker brings no camera"
        )
    else:
        fx, fy, cx, cy, distortion = CAMERAS[int(found[1])]
        # The benchmark has pixel centres at whole numbers, this project at +0.5.
        intrinsics = Intrinsics(PinholeCamera(fx, fy, cx + 0.5, cy + 0.5, WIDTH, HEIGHT), distortion)
        notes.append(f"the camera is taken to be the benchmark's freiburg{found[1]}")
    return ListedImages(path, [name for _, name in there], [time for time, _ in there], intrinsics, notes)


def read_listing(file: Path) -> list[tuple[float, str]]:
    """Read a listing such as `rgb.txt`, with a time [s] and a path per line. `#` starts a comment.

    Args:
        file: The listing.

    Returns:
        Time [s] and path of each entry.

    Raises:
        InputError: If the listing is missing, empty or malformed, times are not strictly increasing, or a path is
            listed twice.
    """
    entries: list[tuple[float, str]] = []
    first_line: dict[str, int] = {}
    for number, line in enumerate(input_lines(file, HINT), 1):
        words = line.partition("#")[0].split(maxsplit=1)
        if not words:
            continue
        where = f"{file}:{number}"
        if len(words) != 2:
            raise InputError(f"{where}: must be a time stamp and a path, not {line.strip()!r}")
        name = Path(words[1].strip()).as_posix()
        try:
            time = float(words[0])
        except ValueError:
            time = math.nan
        if not abs(time) <= LARGEST:
            raise InputError(f"{where}: the time stamp {words[0]!r} is no finite number of seconds")
        if entries and time <= entries[-1][0]:
            raise InputError(f"{where}: time stamp {words[0]} is not later than the one before; sort the listing")
        if name in first_line:
            raise InputError(f"{where}: {name} is listed before, in line {first_line[name]}; take one of them out")
        first_line[name] = number
        entries.append((time, name))
    if not entries:
        raise InputError(f"{file}: lists no image; its lines must be a time stamp and a path")
    return entries
