"""A given list of image files in a folder, decoded one at a time."""

from __future__ import annotations

import io
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import open_file, read_bytes
from modp_ti.files.errors import UnreadableImageError
from modp_ti.inputs.sources.bit_depth import DEPTHS, reduced, used_bits
from modp_ti.inputs.sources.heif import decoded_heif, is_heif
from modp_ti.inputs.sources.image_bounds import why_undecodable
from modp_ti.inputs.sources.image_header import ImageHeader, read_image_header
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.orientation import AS_STORED, Turn, turns_of
from modp_ti.inputs.sources.protocol import IMAGE_SUFFIXES, ImageSource

__all__ = ["ListedImages", "decoded", "decoded_as", "quiet_opencv"]

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
        turn, _ = self.turn(name), self._bits  # both add their notes when the source is opened
        try:
            with self._open(name) as file:
                header = read_image_header(file)
        except OSError as error:
            raise self._unreadable(name, error.strerror or "it cannot be opened") from None
        if header is None:
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
        data = self._checked(name)
        image = decoded(data, bits)
        if image is None:
            raise self._unreadable(name, "it is damaged or no image")
        return turn.image(image)

    def _open(self, name: str) -> BinaryIO:
        """Open an image file. Raises OSError."""
        return open_file(self.path / name)

    def _content(self, name: str) -> bytes:
        """Read an image file. Raises OSError."""
        return read_bytes(self.path / name)

    def _checked(self, name: str) -> bytes:
        """Read an image file and check that it can be decoded. Raises UnreadableImageError."""
        try:
            data = self._content(name)
        except OSError as error:
            raise self._unreadable(name, error.strerror or "it cannot be opened") from None
        header = read_image_header(io.BytesIO(data))
        if not data:
            raise self._unreadable(name, "the file is empty")
        if header is not None and not header.complete:
            raise self._unreadable(name, "the file is cut off")
        reason = why_undecodable(data)
        if reason is not None:
            raise self._unreadable(name, reason)
        return data

    @cached_property
    def _turns(self) -> dict[str, Turn]:
        """The turn of each image that is not kept as it is stored, by name."""
        turns, note = turns_of(self._headers)
        if note is not None:
            self.add_note(f"{self.path}: {note}")
        return turns

    @cached_property
    def _bits(self) -> int:
        """How many bits the images of 16 bits per channel use, by some of them; 16 where there are none."""
        deep = [name for name in self.names if name not in self._headers or self._headers[name].bits > 8]
        images: list[NDArray] = []
        for name in deep[:: max(1, len(deep) // SAMPLED)]:
            with suppress(UnreadableImageError):
                image = decoded_deep(self._checked(name))
                if image is None or image.dtype != np.uint16:
                    break
                images.append(image)
        bits = used_bits(images) if images else DEPTHS[-1]
        if bits < DEPTHS[-1]:
            self.add_note(f"{self.path}: the images have 16 bits and use {bits}: {(1 << bits) - 1} is taken as white")
        return bits

    @cached_property
    def _headers(self) -> dict[str, ImageHeader]:
        """The header of each JPEG, PNG, HEIC and AVIF file that can be read, by name. All are read at once."""
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


def decoded(data: bytes, bits: int = DEPTHS[-1]) -> NDArray[np.uint8] | None:
    """Decode an image file's bytes to (H, W, 3) uint8 RGB, without EXIF rotation (HEIC upright); None if that fails.

    Args:
        data: The file's content.
        bits: How many bits an image of 16 bits per channel uses.
    """
    import cv2

    if is_heif(data[:12]):
        return decoded_heif(data)
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = decoded_as(data, flags) if bits == DEPTHS[-1] else decoded_deep(data)
    return None if image is None else np.asarray(cv2.cvtColor(reduced(image, bits), cv2.COLOR_BGR2RGB), dtype=np.uint8)


def decoded_deep(data: bytes) -> NDArray | None:
    """Decode an image file's bytes to (H, W, 3) BGR, uint8 or uint16 as it is stored; None if that fails."""
    import cv2

    image = decoded_as(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    return image if image is not None and image.dtype in (np.uint8, np.uint16) else None


def decoded_as(data: bytes, flags: int) -> NDArray | None:
    """Decode an image file's bytes with OpenCV's flags, BGR and silently; None if that fails."""
    import cv2

    with quiet_opencv():
        try:
            return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error:
            return None


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silence OpenCV on the terminal within the block. Errors are reported by the caller."""
    import cv2

    log_level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(log_level)
