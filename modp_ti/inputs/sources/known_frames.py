"""Frames that are all known when a source is opened: their names, places and times."""

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
    """What every source does alike that is no live one. path: of the source. times [s]: of each name."""

    def __init__(self, path: Path, names: Sequence[str], times: Sequence[float] | NDArray[np.float64]) -> None:
        super().__init__(path)
        self._names = tuple(names)
        self._times = times
        self._position = {name: i for i, name in enumerate(self._names)}

    @property
    def names(self) -> tuple[str, ...]:
        return self._names

    def position(self, name: str) -> int:
        """Place of a frame in the order, from 0."""
        return self._position[name]

    def timestamp(self, name: str) -> float:
        """When the frame was taken [s]."""
        return float(self._times[self._position[name]])

    def find(self, name: str) -> str | None:
        """The frame that a tracker's file name means, or None: see `find_frame`."""
        return find_frame(name, self._position)

    def selected(self, start: int, stop: int | None, step: int) -> Sequence[str]:
        """Names at positions start, start + step, ... before stop; raises InputError where that is none."""
        names = self.names[start:stop:step]
        if not names:
            raise InputError(
                f"{self.path}: source.start={start} leaves no frame of the {len(self.names)} "
                f"in the {'folder' if self.path.is_dir() else 'file'}"
            )
        return names


def find_frame(name: str, frames: Container[str]) -> str | None:
    """The frame of that name, whatever folders before it and image suffix behind it; None for any other name.

    For sources that name their frames themselves. A number alone finds nothing: programs that extract frames count
    from 0 or from 1.
    """
    path = PurePosixPath(name.replace("\\", "/"))
    tail = path.stem if path.suffix.lower() in IMAGE_SUFFIXES else path.name
    return tail if tail in frames else None
