"""Image files that lie in a folder, known by name and in their order, decoded one at a time."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import open_file, read_bytes
from modp_ti.files.errors import UnreadableImageError
from modp_ti.inputs.sources.image_bounds import why_undecodable
from modp_ti.inputs.sources.image_header import read_image_header
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.known_frames import IMAGE_SUFFIXES, KnownFrames

__all__ = ["ListedImages", "decoded"]


class ListedImages(KnownFrames):
    """An `ImageSource` of files under one folder.

    names: relative to the folder, with forward slashes, each once. times [s]: of each. intrinsics: what the data set
    says of its camera, where it does. vignette (H, W, 3) of maximum 1: the light that reaches each part of the stored
    image, where the data set brings it. notes: remarks for the user.
    """

    def __init__(
        self,
        path: Path,
        names: Sequence[str],
        times: Sequence[float] | NDArray[np.float64],
        intrinsics: Intrinsics | None = None,
        notes: Iterable[str] = (),
        vignette: NDArray[np.float32] | None = None,
    ) -> None:
        super().__init__(path, names, times)
        self.intrinsics = intrinsics
        self._notes += notes
        self.vignette = vignette
        self._by_stem: dict[str, str] = {}
        for name in self.names:
            self._by_stem.setdefault(str(PurePosixPath(name).with_suffix("")), name)

    def find(self, name: str) -> str | None:
        """The image that a tracker's file name means, or None.

        The name may be a path from elsewhere (`./train/0001.png` is `0001.png` here, where the folder is
        `train`) and may lack its suffix.
        """
        parts = PurePosixPath(name.replace("\\", "/")).parts
        for first in range(len(parts)):
            tail = "/".join(parts[first:])
            if tail in self._position:
                return tail
            # Only a name without an image suffix may take another's: `a.png` is not `a.jpg`.
            if not tail.lower().endswith(IMAGE_SUFFIXES) and tail in self._by_stem:
                return self._by_stem[tail]
        return None

    def with_stem(self, stem: str) -> str | None:
        """The image with this path without its suffix, or None."""
        return self._by_stem.get(stem)

    def size(self, name: str) -> tuple[int, int]:
        """(width, height) as stored. Raises UnreadableImageError for one that is unreadable or cut off."""
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
        """Decoded image (H, W, 3) uint8 RGB, without EXIF rotation: intrinsics belong to the stored pixels.

        Raises UnreadableImageError for one that is unreadable or cut off.
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
    """The image (H, W, 3) uint8 RGB in an encoded file, as stored; None where it is none."""
    import cv2

    log_level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:  # silent: the one line that the user gets is ours
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    finally:
        cv2.utils.logging.setLogLevel(log_level)
    return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
