"""What a source of images is, and its camera for those who need one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from modp_ti.errors import InputError
from modp_ti.sources.intrinsics import Intrinsics

__all__ = ["ImageSource", "require_intrinsics"]


class ImageSource(Protocol):
    """Images by name, in the order in which they were taken, each decoded when it is asked for.

    path: where they are, for messages. names: all of them; those of a live source grow while it runs. intrinsics: what
    the user or else the source itself says of its camera, None where nobody says anything. notes: one-line remarks for
    the user; a live source has more of them at its end. A source that knows its lens's vignette has it as `vignette`
    (H, W, 3) float32, at most 1, of the stored image's field of view; None where it does not. One whose images say
    themselves which pixels count has `valid(name)`, (H, W) bool or None where all do.
    """

    path: Path
    intrinsics: Intrinsics | None
    notes: list[str]

    @property
    def names(self) -> Sequence[str]: ...

    def __len__(self) -> int: ...

    def position(self, name: str) -> int:
        """Place of an image among `names`."""
        ...

    def timestamp(self, name: str) -> float:
        """When it was taken [seconds]."""
        ...

    def find(self, name: str) -> str | None:
        """The image that a tracker's file name means, or None."""
        ...

    def selected(self, start: int, stop: int | None, step: int) -> Sequence[str]:
        """Names at positions start, start + step, ... before stop. Raises InputError where that is none."""
        ...

    def arriving(self, start: int, stop: int | None, step: int) -> Iterator[str]:
        """The same names one by one, each as soon as its image is there. Ends when no more will come."""
        ...

    def size(self, name: str) -> tuple[int, int]:
        """(width, height) as stored. Raises InputError for an image that is unreadable."""
        ...

    def read(self, name: str) -> NDArray[np.uint8]:
        """Decoded image (H, W, 3) uint8 RGB as stored. Raises InputError for an image that is unreadable.

        May be called for any name at any time after it has arrived, more than once and from one other thread.
        """
        ...

    def close(self) -> None:
        """Let go of what is open: a camera, a file."""
        ...


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
        images.notes.append(images.intrinsics.note)
    return images.intrinsics
