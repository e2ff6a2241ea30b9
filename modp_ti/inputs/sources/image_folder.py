"""Source `images`: a folder of images in natural order."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.known_frames import IMAGE_SUFFIXES
from modp_ti.inputs.sources.listed_images import ListedImages
from modp_ti.inputs.sources.name_times import times_of_names

__all__ = ["IMAGE_SUFFIXES", "ImageFolder", "natural_key"]


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Return a sort key that compares digits by value, ignoring leading zeros: frame2 comes before frame10."""
    parts = re.split(r"([0-9]+)", name.casefold())
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts if part], name


class ImageFolder(ListedImages):
    """The images in a folder and its subfolders, without hidden files.

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
            subfolders[:] = [name for name in subfolders if not name.startswith(".")]
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
