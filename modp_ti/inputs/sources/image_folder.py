"""Image files: a given list of them in a folder, or all that a folder holds, decoded one at a time."""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import open_file, read_bytes
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.files.run_folder import PRIVATE
from modp_ti.inputs.sources.image_header import ImageHeader, decodable, read_image_header
from modp_ti.inputs.sources.image_pixels import (
    DEPTHS,
    alpha_of,
    decoded,
    decoded_deep,
    used_bits,
    way_to_srgb,
)
from modp_ti.inputs.sources.orientation import AS_STORED, Turn, turns_of
from modp_ti.inputs.sources.protocol import IMAGE_SUFFIXES, ImageSource
from modp_ti.inputs.sources.undistortion import Intrinsics

SAMPLED = 16  # images of 16 bits per channel by which their depth is found


class ListedImages(ImageSource):
    """An `ImageSource` of files in one folder.

    Args:
        path: The folder.
        names: Unique file names relative to the folder, with forward slashes.
        times: Time of each image [s].
        intrinsics: Camera of the data set, if known.
        notes: Remarks for the user.
    """

    def __init__(
        self,
        path: Path,
        names: Sequence[str],
        times: Sequence[float] | NDArray[np.float64],
        intrinsics: Intrinsics | None = None,
        notes: Iterable[str] = (),
    ) -> None:
        super().__init__(path, names, times)
        self.intrinsics = intrinsics
        self._notes += notes
        self._by_stem: dict[str, str] = {}
        for name in self.names:
            self._by_stem.setdefault(str(PurePosixPath(name).with_suffix("")), name)

    def find(self, name: str) -> str | None:
        """Find the image that a tracker's file name refers to, or return None.

        Leading folders may be missing in this source (`./train/0001.png` matches `0001.png` if the source is the folder
        `train`), and the name may lack its suffix.
        """
        for tail in _tails(name):
            if tail in self._position:
                return tail
            # Only a name without an image suffix may match any suffix: `a.png` is not `a.jpg`.
            if not tail.lower().endswith(IMAGE_SUFFIXES) and tail in self._by_stem:
                return self._by_stem[tail]
        return None

    def find_all(self, names: Sequence[str]) -> tuple[list[str | None], str | None]:
        """Find the images that all file names of a tracker refer to.

        Names without an image are then compared without regard to case, Unicode's forms and at last image suffixes,
        where only one image and one name are alike so.
        """
        found = [self.find(name) for name in names]
        free = set(self.names) - set(found)
        first = None
        for likeness in (_folded, lambda name: _folded(str(PurePosixPath(name).with_suffix("")))):
            alike, asked = _grouped(free, likeness), _grouped(names, likeness)
            for number, name in enumerate(names):
                for tail in _tails(name) if found[number] is None else ():
                    one = alike.get(likeness(tail), [])
                    if len(one) == 1 and len(asked[likeness(name)]) == 1:
                        found[number] = one[0]
                        first = first or f"{name} is {one[0]}"
                        break
            free -= set(found)
        return found, first and f"its names are written in another way than those in {self.path}: {first}"

    def with_stem(self, stem: str) -> str | None:
        """Return the image whose path without suffix is `stem`, or None."""
        return self._by_stem.get(stem)

    def size(self, name: str) -> tuple[int, int]:
        """Return the size (width, height) of the image, turned upright.

        Raises:
            UnreadableImageError: If the image is unreadable or truncated.
        """
        turn, _, _ = self.turn(name), self._bits, self._transparent  # they add their notes when the source is opened
        header = self.headers.get(name)
        if header is not None and header.complete:
            return turn.size(header.width, header.height)
        height, width = self.read(name).shape[:2]
        return width, height

    def turn(self, name: str) -> Turn:
        """Return how the stored image is turned upright."""
        return self._turns.get(name, AS_STORED)

    def read(self, name: str) -> NDArray[np.uint8]:
        """Decode an image (H, W, 3) uint8 RGB, turned upright as EXIF says. Of 16 bits, the used ones are reduced to 8.

        Raises:
            UnreadableImageError: If the image is unreadable or truncated.
        """
        turn, bits = self.turn(name), self._bits
        image = decoded(*self._checked(name), bits)
        if image is None:
            raise self._unreadable(name, "it is damaged, or of numbers that are not read: convert it to 16 bits")
        return turn.image(image)

    def valid(self, name: str) -> NDArray[np.bool_] | None:
        """Return the pixels (H, W) whose alpha is at least half, turned upright; None if there is no alpha."""
        if name not in self._transparent:
            return None
        alpha = alpha_of(*self._checked(name))
        return None if alpha is None else self.turn(name).image(alpha)

    def leave_out(self, names: Collection[str]) -> None:
        """Take images out of the source, such as masks that a tracker's file names."""
        kept = [(name, time) for name, time in zip(self._names, self._times, strict=True) if name not in names]
        self._names, self._times, self._position, self._by_stem = [], [], {}, {}
        for name, time in kept:
            self._append(name, time)
            self._by_stem.setdefault(str(PurePosixPath(name).with_suffix("")), name)

    def _open(self, name: str) -> BinaryIO:
        """Open an image file. Raises OSError."""
        return open_file(self.path / name)

    def _content(self, name: str) -> bytes:
        """Read an image file. Raises OSError."""
        return read_bytes(self.path / name)

    def _checked(self, name: str) -> tuple[bytes, ImageHeader]:
        """Read an image file and check that it can be decoded. Raises UnreadableImageError."""
        try:
            data = self._content(name)
            return data, decodable(data)
        except OSError as error:
            raise self._unreadable(name, error.strerror or str(error)) from None

    @cached_property
    def _turns(self) -> dict[str, Turn]:
        """The turn of each image that is not kept as it is stored, by name."""
        turns, note = turns_of(self.headers)
        if note is not None:
            self.add_note(f"{self.path}: {note}")
        if any(way_to_srgb(header.profile) for header in self.headers.values()):
            self.add_note(f"{self.path}: images of another colour profile than sRGB are converted to sRGB")
        return turns

    @cached_property
    def _transparent(self) -> frozenset[str]:
        """The images whose alpha is a mask: those that have one, unless it is 0 everywhere in some of them."""
        names = [name for name, header in self.headers.items() if header.alpha]
        some = []
        for name in names[:: max(1, len(names) // SAMPLED)]:
            with suppress(UnreadableImageError):
                alpha = alpha_of(*self._checked(name))
                some.append(True if alpha is None else alpha)
        used = not some or any(map(np.any, some))
        if not all(map(np.all, some)):
            what = "where their alpha is below half" if used else "nowhere, as their alpha is 0 everywhere"
            self.add_note(f"{self.path}: images with an alpha channel are masked {what}")
        return frozenset(names if used else ())

    @cached_property
    def _bits(self) -> int:
        """How many bits the images of 16 bits per channel use, by some of them; 16 where there are none."""
        deep = [name for name in self.names if name not in self.headers or self.headers[name].bits > 8]
        images: list[NDArray] = []
        for name in deep[:: max(1, len(deep) // SAMPLED)]:
            with suppress(UnreadableImageError):
                image = decoded_deep(self._checked(name)[0])
                if image is None or image.dtype != np.uint16:
                    break
                images.append(image)
        if not images:
            return DEPTHS[-1]
        bits, notes = used_bits(images, self.path)
        self._notes += notes
        return bits

    @cached_property
    def headers(self) -> dict[str, ImageHeader]:
        """The header of each file that is not damaged, by name. All are read at once."""
        headers = {}
        for name in self.names:
            with suppress(OSError), self._open(name) as file:
                headers[name] = read_image_header(file)
        return headers

    def _unreadable(self, name: str, reason: str) -> UnreadableImageError:
        return UnreadableImageError(
            f"{self.path / name}: unreadable image: {reason}; replace it or take it out of the folder"
        )


def _tails(name: str) -> list[str]:
    """Return a path, and what is left of it without its first folder, the first two, ..."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    return ["/".join(parts[first:]) for first in range(len(parts))]


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _grouped(names: Iterable[str], key: Callable[[str], str]) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(key(name), []).append(name)
    return groups


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
        return int(start[1]) > 255 if start else header.grey and header.bits == 16
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
