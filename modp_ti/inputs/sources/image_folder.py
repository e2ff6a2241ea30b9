"""Source `images`: a folder of images in natural order."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import PRIVATE
from modp_ti.inputs.sources.listed_images import ListedImages
from modp_ti.inputs.sources.protocol import IMAGE_SUFFIXES

__all__ = ["IMAGE_SUFFIXES", "ImageFolder", "natural_key", "times_of_names"]

# Unit of a whole number by its digits, for times since 2001: milliseconds, microseconds, nanoseconds. Ten digits are
# not accepted: whole seconds would not distinguish the frames of a video.
UNITS = {13: 1e-3, 16: 1e-6, 19: 1e-9}
SECONDS = re.compile(r"[0-9]{10}\.[0-9]{2,}")


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Return a sort key that compares digits by value, ignoring leading zeros: frame2 comes before frame10."""
    parts = re.split(r"([0-9]+)", name.casefold())
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts if part], name


class ImageFolder(ListedImages):
    """The images in a folder and its subfolders, without hidden files and the output folders of runs.

    Names are relative to the folder, with forward slashes. If all names are time stamps, as in EuRoC's and TUM's
    folders, they give the times.

    Args:
        path: The folder.
        fps: Images per second, used if the names are not time stamps.
        setting: The setting that named the folder, for error messages.

    Raises:
        InputError: If the folder does not exist or has no images.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float = 30.0, setting: str = "source.path") -> None:
        path = Path(path)
        if not path.exists():
            raise InputError(f"{path}: no such folder of images ({setting})")
        if not path.is_dir():
            raise InputError(f"{path}: {setting} must be a folder of images, this is a file")
        found: list[str] = []
        for folder, subfolders, files in os.walk(path):
            subfolders[:] = [
                name for name in subfolders if name[0] != "." and not os.path.isdir(os.path.join(folder, name, PRIVATE))
            ]
            inside = Path(folder).relative_to(path)
            found += [
                (inside / name).as_posix()
                for name in files
                if name.lower().endswith(IMAGE_SUFFIXES) and not name.startswith(".")
            ]
        if not found:
            raise InputError(f"{path}: holds no image ({', '.join(IMAGE_SUFFIXES)})")
        names = sorted(found, key=natural_key)
        times = times_of_names(names)
        notes = [] if times is None else [f"{path}: the images' names are taken as their times"]
        super().__init__(path, names, np.arange(len(names)) / fps if times is None else times, notes=notes)


def times_of_names(names: Sequence[str]) -> NDArray[np.float64] | None:
    """Return the times (N,) [s] of images whose names are strictly increasing time stamps, otherwise None."""
    stems = [PurePosixPath(name).stem for name in names]
    if all(SECONDS.fullmatch(stem) for stem in stems):
        times = np.array([float(stem) for stem in stems])
    elif all(re.fullmatch("[1-9][0-9]+", stem) and len(stem) in UNITS for stem in stems):
        if len({len(stem) for stem in stems}) > 1:
            return None
        times = np.array([int(stem) for stem in stems]) * UNITS[len(stems[0])]
    else:
        return None
    return times if (np.diff(times) > 0).all() else None
