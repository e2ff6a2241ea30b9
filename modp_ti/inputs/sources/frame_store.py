"""Lossless storage of a stream's frames in a folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.runtime.process import has_room
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.image_header import read_image_header
from modp_ti.inputs.sources.image_pixels import decoded
from modp_ti.inputs.sources.protocol import ImageSource


def kept_frames(folder: Path) -> dict[str, dict[str, str | None]]:
    """Return the settings that read the delivered frames again, see `Tracker.kept`."""
    return {"source": {"stream": None, "path": str(folder), "kind": "tum_rgbd"}}


def list_frames(folder: Path) -> None:
    """Write the list that makes the folder of a killed process a recording. Raises OSError if it cannot be written."""
    lines = []
    for file in sorted(folder.glob("[0-9]*.png")):
        with file.open("rb") as image:
            header = read_image_header(image)
        if header is not None and header.complete:  # the last one may be cut off
            lines.append(f"{file.stat().st_mtime_ns / 1e9!r} {file.name}\n")
    (folder / "rgb.txt").write_text("".join(lines), encoding="utf-8")


class FrameStore:
    """Frames of a live source by number, as PNG files.

    Args:
        folder: The folder, which exists.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @staticmethod
    def name(number: int) -> str:
        """Name of the n-th delivered frame."""
        return f"live_{number:06d}"

    def file(self, number: int) -> Path:
        return self.folder / f"{number:06d}.png"

    def waiting_file(self, number: int) -> Path:
        """Place of a frame that has not been delivered, by the order of arrival."""
        return self.folder / f"waiting-{number:06d}.png"

    def write(self, file: Path, image: NDArray[np.uint8]) -> None:
        """Store a frame (H, W, 3) BGR in one of these files.

        Raises:
            InputError: If it cannot be written, or would leave too little of the disk free.
        """
        import cv2

        # Huffman coding of differences to the left takes half the time of OpenCV's default for the same size.
        how = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
        if hasattr(cv2, "IMWRITE_PNG_FILTER"):  # since OpenCV 4.11
            how += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]
        _, data = cv2.imencode(".png", image, how)
        try:
            if not has_room(self.folder, len(data)):
                raise InputError(
                    f"{self.folder.parent}: less than 1 GiB is free for the frames of the live source; make room, or "
                    "set TMPDIR to a folder that has some"
                )
            file.write_bytes(data.data)
        except OSError as error:
            file.unlink(missing_ok=True)
            raise self._unwritable(error) from None

    def deliver(self, waiting: Path, number: int) -> None:
        """Give a waiting frame its number."""
        try:
            os.replace(waiting, self.file(number))
        except OSError as error:
            raise self._unwritable(error) from None

    def date(self, number: int, time: float) -> None:
        """Give the file of a delivered frame its time [s], for `list_frames`."""
        with suppress(OSError):  # on file systems that keep no such times
            os.utime(self.file(number), (time, time))

    def read(self, name: str) -> NDArray[np.uint8]:
        """Read a delivered frame (H, W, 3) uint8 RGB.

        Raises:
            InputError: If the file is missing or damaged.
        """
        file = self.file(int(name.rpartition("_")[2]))
        try:
            image = decoded(file.read_bytes())
        except OSError:
            image = None
        if image is None:
            raise InputError(f"{file}: the frame that was kept there is gone or damaged: leave the folder alone")
        return image

    def _unwritable(self, error: OSError) -> InputError:
        return InputError(
            f"{self.folder}: frames of the live source cannot be kept there: {error.strerror}; "
            "make room, or set TMPDIR to a folder that has some"
        )


class StoredFrames(ImageSource):
    """The stored frames of a recording that has ended, for a process that did not record it.

    Args:
        folder: The folder of a `FrameStore`.
        names: Names of the frames, in order.
    """

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        super().__init__(folder, names, [0.0] * len(names))
        self._store = FrameStore(folder)

    def read(self, name: str) -> NDArray[np.uint8]:
        return self._store.read(name)
