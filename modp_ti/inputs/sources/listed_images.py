"""A given list of image files in a folder, decoded one at a time."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import open_file, read_bytes
from modp_ti.files.errors import UnreadableImageError
from modp_ti.inputs.sources.image_bounds import why_undecodable
from modp_ti.inputs.sources.image_header import read_image_header
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.protocol import IMAGE_SUFFIXES, ImageSource

__all__ = ["ListedImages", "decoded", "decoded_as", "quiet_opencv"]


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
        parts = PurePosixPath(name.replace("\\", "/")).parts
        for first in range(len(parts)):
            tail = "/".join(parts[first:])
            if tail in self._position:
                return tail
            # Only a name without an image suffix may match any suffix: `a.png` is not `a.jpg`.
            if not tail.lower().endswith(IMAGE_SUFFIXES) and tail in self._by_stem:
                return self._by_stem[tail]
        return None

    def with_stem(self, stem: str) -> str | None:
        """Return the image whose path without suffix is `stem`, or None."""
        return self._by_stem.get(stem)

    def size(self, name: str) -> tuple[int, int]:
        """Return the size (width, height) of the stored image.

        Raises:
            UnreadableImageError: If the image is unreadable or truncated.
        """
        try:
            with open_file(self.path / name) as file:
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
        return header.width, header.height

    def read(self, name: str) -> NDArray[np.uint8]:
        """Decode an image (H, W, 3) uint8 RGB. EXIF rotation is not applied: intrinsics belong to the stored pixels.

        Raises:
            UnreadableImageError: If the image is unreadable or truncated.
        """
        try:
            data = read_bytes(self.path / name)
        except OSError as error:
            raise self._unreadable(name, error.strerror or "it cannot be opened") from None
        header = read_image_header(io.BytesIO(data))
        if not data:
            raise self._unreadable(name, "the file is empty")
        if header is not None and not header.complete:
            raise self._unreadable(name, "the file is cut off")
        reason = why_undecodable(data)
        image = decoded(data) if reason is None else None
        if image is None:
            raise self._unreadable(name, reason or "it is damaged or no image")
        return image

    def _unreadable(self, name: str, reason: str) -> UnreadableImageError:
        return UnreadableImageError(
            f"{self.path / name}: unreadable image: {reason}; replace it or take it out of the folder"
        )


def decoded(data: bytes) -> NDArray[np.uint8] | None:
    """Decode an image file's bytes to (H, W, 3) uint8 RGB, without EXIF rotation; None if that fails."""
    import cv2

    image = decoded_as(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return None if image is None else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


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
