"""What a source of images is, and its camera for those who need one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.intrinsics import Intrinsics

__all__ = ["ImageSource", "require_intrinsics"]


class ImageSource(ABC):
    """Images by name, in the order in which they were taken, each decoded when it is asked for.

    path: where they are, for messages. intrinsics: what the user or else the source itself says of its camera, None
    where nobody says anything. vignette: how much light reaches each part of the stored image's field of view,
    (H, W, 3) float32 of at most 1, None where the source does not know. T_device_camera: (4, 4), where the camera sits
    on a device with other sensors, OpenCV axes, None for a camera by itself.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.intrinsics: Intrinsics | None = None
        self.vignette: NDArray[np.float32] | None = None
        self.T_device_camera: NDArray[np.float64] | None = None
        self._notes: list[str] = []

    @property
    def notes(self) -> list[str]:
        """One-line remarks for the user; a live source has more of them at its end."""
        return self._notes

    def add_note(self, note: str, first: bool = False) -> None:
        """Add a remark, behind the others or before them."""
        self._notes.insert(0 if first else len(self._notes), note)

    @property
    @abstractmethod
    def names(self) -> Sequence[str]:
        """Names of all images; those of a live source grow while it runs."""

    def __len__(self) -> int:
        return len(self.names)

    @abstractmethod
    def position(self, name: str) -> int:
        """Place of an image among `names`, from 0."""

    @abstractmethod
    def timestamp(self, name: str) -> float:
        """When it was taken [seconds]."""

    @abstractmethod
    def find(self, name: str) -> str | None:
        """The image that a tracker's file name means, or None."""

    @abstractmethod
    def selected(self, start: int, stop: int | None, step: int) -> Sequence[str]:
        """Names at positions start, start + step, ... before stop. Raises InputError where that is none."""

    def arriving(self, start: int, stop: int | None, step: int) -> Iterator[str]:
        """The same names one by one, each as soon as its image is there. Ends when no more will come."""
        return iter(self.selected(start, stop, step))

    @property
    def frame_size(self) -> tuple[int, int]:
        """(width, height) of the first image, which a live source knows before it has delivered any."""
        return self.size(self.names[0])

    @abstractmethod
    def size(self, name: str) -> tuple[int, int]:
        """(width, height) as stored. Raises InputError for an image that is unreadable."""

    @abstractmethod
    def read(self, name: str) -> NDArray[np.uint8]:
        """Decoded image (H, W, 3) uint8 RGB as stored. Raises InputError for an image that is unreadable.

        May be called for any name at any time after it has arrived, more than once and from one other thread.
        """

    def valid(self, name: str) -> NDArray[np.bool_] | None:
        """Which pixels (H, W) the image itself says to count; None where it says nothing."""
        return None

    def close(self) -> None:  # noqa: B027 - most sources hold nothing open
        """Let go of what is open: a camera, a file."""


def require_intrinsics(images: ImageSource) -> Intrinsics:
    """The camera of the source, for a tracker that brings none; its note goes to the source's.

    Raises InputError where it is not known.
    """
    if images.intrinsics is None:
        raise InputError(
            f"{images.path}: the camera is not known: give source.intrinsics: {{fx: ..., fy: ..., cx: ..., cy: ...}} "
            "in pixels of the stored images"
        )
    if images.intrinsics.note is not None:
        images.add_note(images.intrinsics.note)
    return images.intrinsics
