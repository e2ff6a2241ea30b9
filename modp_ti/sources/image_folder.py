"""A folder of images: listed in natural order, decoded one at a time."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from modp_ti.errors import InputError
from modp_ti.sources.image_header import read_image_header
from modp_ti.sources.intrinsics import Intrinsics

__all__ = ["IMAGE_SUFFIXES", "ImageFolder", "natural_key"]

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Sort key that counts numbers as numbers: frame2 before frame10, whatever the zeros before them."""
    parts = re.split(r"([0-9]+)", name.casefold())
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts if part], name


class ImageFolder:
    """The images under one folder, subfolders included, hidden files left out.

    Names are relative to the folder, with forward slashes. Raises InputError where there is no such folder or
    no image. fps: images a second, where their place is all that is known of their time. setting: the key that named
    the folder, for messages.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float = 30.0, setting: str = "source.path") -> None:
        self.path = Path(path)
        self.intrinsics: Intrinsics | None = None
        self.notes: list[str] = []
        self._fps = fps
        if not self.path.exists():
            raise InputError(f"{self.path}: no such folder of images ({setting})")
        if not self.path.is_dir():
            raise InputError(f"{self.path}: {setting} must be a folder of images, this is a file")
        found: list[str] = []
        for folder, subfolders, files in os.walk(self.path):
            subfolders[:] = [name for name in subfolders if not name.startswith(".")]
            inside = Path(folder).relative_to(self.path)
            found += [
                (inside / name).as_posix()
                for name in files
                if name.lower().endswith(IMAGE_SUFFIXES) and not name.startswith(".")
            ]
        if not found:
            raise InputError(f"{self.path}: holds no image ({', '.join(IMAGE_SUFFIXES)})")
        self.names: tuple[str, ...] = tuple(sorted(found, key=natural_key))
        self._position = {name: i for i, name in enumerate(self.names)}
        self._by_stem: dict[str, str] = {}
        for name in self.names:
            self._by_stem.setdefault(str(PurePosixPath(name).with_suffix("")), name)

    def __len__(self) -> int:
        return len(self.names)

    def position(self, name: str) -> int:
        """Place of an image in the natural order, from 0."""
        return self._position[name]

    def timestamp(self, name: str) -> float:
        """Seconds since the first image of the folder."""
        return self._position[name] / self._fps

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

    def selected(self, start: int, stop: int | None, step: int) -> Sequence[str]:
        """Names at positions start, start + step, ... before stop; raises InputError where that is none."""
        names = self.names[start:stop:step]
        if not names:
            raise InputError(
                f"{self.path}: source.start={start} leaves no frame of the {len(self.names)} in the folder"
            )
        return names

    def arriving(self, start: int, stop: int | None, step: int) -> Iterator[str]:
        """The same names, one by one."""
        return iter(self.selected(start, stop, step))

    def size(self, name: str) -> tuple[int, int]:
        """(width, height) as stored. Raises InputError for an image that is unreadable or cut off."""
        try:
            with (self.path / name).open("rb") as file:
                header = read_image_header(file)
        except OSError as error:
            raise self._unreadable(name, error.strerror or "it cannot be opened") from None
        if header is None:
            height, width = self.read(name).shape[:2]
            return width, height
        if not header.complete:
            raise self._unreadable(name, "the file is cut off")
        return header.width, header.height

    def read(self, name: str) -> NDArray[np.uint8]:
        """Decoded image (H, W, 3) uint8 RGB, without EXIF rotation: intrinsics belong to the stored pixels.

        Raises InputError for an image that is unreadable or cut off.
        """
        import cv2

        try:
            data = (self.path / name).read_bytes()
        except OSError as error:
            raise self._unreadable(name, error.strerror or "it cannot be opened") from None
        header = read_image_header(io.BytesIO(data))
        if not data:
            raise self._unreadable(name, "the file is empty")
        if header is not None and not header.complete:
            raise self._unreadable(name, "the file is cut off")
        log_level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:  # silent: the one line that the user gets is ours
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        except cv2.error:
            image = None
        finally:
            cv2.utils.logging.setLogLevel(log_level)
        if image is None:
            raise self._unreadable(name, "it is damaged or no image")
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def close(self) -> None:
        """Nothing stays open."""

    def _unreadable(self, name: str, reason: str) -> InputError:
        return InputError(f"{self.path / name}: unreadable image: {reason}; replace it or take it out of the folder")
