"""A given list of image files in a folder, decoded one at a time."""

from __future__ import annotations

import io
import unicodedata
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import open_file, read_bytes
from modp_ti.files.errors import UnreadableImageError
from modp_ti.inputs.sources.image_header import ImageHeader, read_image_header, why_undecodable
from modp_ti.inputs.sources.image_pixels import (
    DEPTHS,
    alpha_of,
    decoded,
    decoded_as,
    decoded_deep,
    used_bits,
    way_to_srgb,
)
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.orientation import AS_STORED, Turn, turns_of
from modp_ti.inputs.sources.protocol import IMAGE_SUFFIXES, ImageSource

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
        try:
            with self._open(name) as file:
                header = read_image_header(file)
        except OSError as error:
            raise self._unreadable(name, error.strerror or "it cannot be opened") from None
        if header is None or header.complete is None:
            height, width = self.read(name).shape[:2]
            return width, height
        if not header.complete:
            raise self._unreadable(name, "the file is cut off")
        if header.width < 1 or header.height < 1:
            raise self._unreadable(name, "its header is damaged")
        return turn.size(header.width, header.height)

    def turn(self, name: str) -> Turn:
        """Return how the stored image is turned upright."""
        return self._turns.get(name, AS_STORED)

    def read(self, name: str) -> NDArray[np.uint8]:
        """Decode an image (H, W, 3) uint8 RGB, turned upright as EXIF says. Of 16 bits, the used ones are reduced to 8.

        Raises:
            UnreadableImageError: If the image is unreadable or truncated.
        """
        turn, bits = self.turn(name), self._bits
        data, header = self._checked(name)
        image = decoded(data, bits, header)
        if image is None:
            deep = decoded_as(data, -1)  # as it is stored
            what = "it is damaged or no image" if deep is None else f"{deep.dtype} is not read: convert it to 16 bits"
            raise self._unreadable(name, what)
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

    def _checked(self, name: str) -> tuple[bytes, ImageHeader | None]:
        """Read an image file and check that it can be decoded. Raises UnreadableImageError."""
        try:
            data = self._content(name)
        except OSError as error:
            raise self._unreadable(name, error.strerror or "it cannot be opened") from None
        header = read_image_header(io.BytesIO(data))
        if not data:
            raise self._unreadable(name, "the file is empty")
        if header is not None and header.complete is False:
            raise self._unreadable(name, "the file is cut off")
        reason = why_undecodable(data)
        if reason is not None:
            raise self._unreadable(name, reason)
        return data, header

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
        """The header of each file that `read_image_header` can read, by name. All are read at once."""
        headers = {}
        for name in self.names:
            with suppress(OSError), self._open(name) as file:
                header = read_image_header(file)
                if header is not None and header.width > 0:
                    headers[name] = header
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
