"""Base class of sources whose frames are all known when they are opened."""

from __future__ import annotations

from collections.abc import Container, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.protocol import ImageSource

__all__ = ["IMAGE_SUFFIXES", "KnownFrames", "find_frame"]

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")


class KnownFrames(ImageSource):
    """Base class of all sources that are not live.

    Args:
        path: Location of the source.
        names: Names of the frames, in order.
        times: Time of each frame [s].
    """

    def __init__(self, path: Path, names: Sequence[str], times: Sequence[float] | NDArray[np.float64]) -> None:
        super().__init__(path)
        self._names = tuple(names)
        self._times = times
        self._position = {name: i for i, name in enumerate(self._names)}

    @property
    def names(self) -> tuple[str, ...]:
        return self._names

    def position(self, name: str) -> int:
        """Return the position of a frame, from 0."""
        return self._position[name]

    def timestamp(self, name: str) -> float:
        """Return the time at which the frame was taken [s]."""
        return float(self._times[self._position[name]])

    def find(self, name: str) -> str | None:
        """Find the frame that a tracker's file name refers to, or return None; see `find_frame`."""
        return find_frame(name, self._position)

    def selected(self, start: int, stop: int | None, step: int) -> Sequence[str]:
        """Return the names at positions start, start + step, ... before stop.

        Raises:
            InputError: If there are none.
        """
        names = self.names[start:stop:step]
        if not names:
            raise InputError(
                f"{self.path}: source.start={start} leaves no frame of the {len(self.names)} "
                f"in the {'folder' if self.path.is_dir() else 'file'}"
            )
        return names


def find_frame(name: str, frames: Container[str]) -> str | None:
    """Find a frame by name, ignoring folders and an image suffix.

    This is for sources that name their frames themselves. A number alone does not match, because programs that extract
    frames differ in counting from 0 or from 1.

    Args:
        name: File name from a tracker.
        frames: Names of the frames.

    Returns:
        The frame's name, or None if there is no match.
    """
    path = PurePosixPath(name.replace("\\", "/"))
    tail = path.stem if path.suffix.lower() in IMAGE_SUFFIXES else path.name
    return tail if tail in frames else None
