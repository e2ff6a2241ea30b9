"""Source `images`: a folder of images in natural order."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import open_file
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import PRIVATE
from modp_ti.inputs.sources.image_header import read_image_header
from modp_ti.inputs.sources.listed_images import ListedImages
from modp_ti.inputs.sources.protocol import IMAGE_SUFFIXES

__all__ = ["IMAGE_SUFFIXES", "ImageFolder", "natural_key", "times_of_names"]

# Unit of a whole number by its digits, for times since 2001: milliseconds, microseconds, nanoseconds. Ten digits are
# not accepted: whole seconds would not distinguish the frames of a video.
UNITS = {13: 1e-3, 16: 1e-6, 19: 1e-9}
NOT_READ = tuple(".dng .cr2 .cr3 .nef .arw .raf .orf .rw2 .pef .srw .jxl .gif .exr .hdr .tga .psd .jxr .svg".split())
"""Suffixes of pictures that are not read."""
BESIDE = re.compile(r"(?:^|/)(?:masks?|depths?|depth_?maps?|confidences?|normals?)/", re.IGNORECASE)
SECONDS = re.compile(r"[0-9]{10}\.[0-9]{2,}")


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Return a sort key that compares digits by value, ignoring leading zeros: frame2 comes before frame10."""
    parts = re.split(r"([0-9]+)", name.casefold())
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts if part], name


class ImageFolder(ListedImages):
    """The images in a folder and its subfolders, without hidden files and the output folders of runs.

    Names are relative to the folder, with forward slashes. If all names are time stamps, as in EuRoC's and TUM's
    folders, they give the times.

    Where there are colour images, pictures of depth (one channel of 16 bits) are left out, and those in folders called
    `masks`, `depth` and the like that have the names of others.

    Args:
        path: The folder.
        fps: Images per second, used if the names are not time stamps.
        setting: The setting that named the folder, for error messages.
        masks: A folder, perhaps inside, that is not looked into.

    Raises:
        InputError: If the folder does not exist or has no images.
    """

    def __init__(
        self, path: str | os.PathLike[str], fps: float = 30.0, setting: str = "source.path", masks: Path | None = None
    ) -> None:
        path = Path(path)
        if not path.exists():
            raise InputError(f"{path}: no such folder of images ({setting})")
        if not path.is_dir():
            raise InputError(f"{path}: {setting} must be a folder of images, this is a file")
        files: list[str] = []
        for folder, subfolders, names in os.walk(path):
            subfolders[:] = [name for name in subfolders if _is_of_the_recording(Path(folder, name), masks)]
            inside = Path(folder).relative_to(path)
            files += [(inside / name).as_posix() for name in names if not name.startswith(".")]
        found = [name for name in files if name.lower().endswith(IMAGE_SUFFIXES)]
        pure = [PurePosixPath(name) for name in files]
        if not found:
            kinds = Counter(name.suffix.lower() for name in pure).most_common(3)
            there = ", ".join(f"{count} {suffix or 'files without suffix'}" for suffix, count in kinds)
            raise InputError(
                f"{path}: holds no image ({', '.join(IMAGE_SUFFIXES)}), but {there or 'nothing'}: convert pictures to "
                f"JPEG or PNG, and name a recording itself ({setting})"
            )
        notes = []
        if setting == "source.path":
            stems = {PurePosixPath(name).with_suffix("") for name in found}  # cameras write raw files beside JPEG ones
            passed = [name for name in pure if name.suffix.lower() in NOT_READ and name.with_suffix("") not in stems]
            if passed:
                notes.append(f"{path}: {len(passed)} pictures are of formats that are not read, such as {passed[0]}")
            found, left_out = _frames(path, found)
            if left_out:
                notes.append(f"{path}: {len(left_out)} depth maps or masks are not mapped, such as {left_out[0]}")
        names = sorted(found, key=natural_key)
        times = times_of_names(names)
        notes += [] if times is None else [f"{path}: the images' names are taken as their times"]
        super().__init__(path, names, np.arange(len(names)) / fps if times is None else times, notes=notes)


def _is_of_the_recording(folder: Path, masks: Path | None) -> bool:
    """Whether a subfolder may hold images: it is not hidden, no output folder of a run, and not that of the masks."""
    return folder.name[0] != "." and folder != masks and not os.path.isdir(folder / PRIVATE)


def _frames(path: Path, found: list[str]) -> tuple[list[str], list[str]]:
    """Divide the pictures of a folder into images, and depth maps and masks beside them; all are images if none is."""
    kinds: dict[str, list[str]] = {}  # by folder and form of the name
    for name in found:
        kinds.setdefault(re.sub("[0-9]+", "0", name), []).append(name)
    depths = {name for names in kinds.values() if _is_depth(path / names[0]) for name in names}
    stems = {PurePosixPath(name).stem for name in found if not BESIDE.search(name)}
    pure = [PurePosixPath(name) for name in found if BESIDE.search(name)]
    beside = {str(name) for name in pure if {name.stem, name.with_suffix("").stem} & stems}
    left_out = depths | beside
    if len(left_out) in (0, len(found)):
        return found, []
    return [name for name in found if name not in left_out], sorted(left_out, key=natural_key)


def _is_depth(path: Path) -> bool:
    """Whether a picture has one channel of 16 bits."""
    if path.suffix.lower() not in (".png", ".tif", ".tiff", ".pgm"):
        return False
    with suppress(OSError), open_file(path) as file:
        start = re.match(rb"P5\s+[0-9]+\s+[0-9]+\s+([0-9]+)", file.read(64))
        file.seek(0)
        header = read_image_header(file)
        return int(start[1]) > 255 if start else header is not None and header.grey and header.bits == 16
    return False


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
