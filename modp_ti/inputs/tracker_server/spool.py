"""Storage of a received stream in one file, from which images and points are read again, and the stream itself."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints
from fields.runtime.process import has_room
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources import FrameReader
from modp_ti.inputs.sources.image_header import decodable
from modp_ti.inputs.sources.image_pixels import decoded_as
from modp_ti.inputs.sources.protocol import ImageSource
from modp_ti.inputs.tracker_server.messages import (
    FRAME,
    HEADER,
    MAGIC,
    POINT,
    Encoding,
    Frame,
    Hello,
    Kind,
    UnfitError,
    encoded,
    parse_points,
)

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import SourceSettings


class SpoolFullError(Exception):
    """The disk has no space for another message. The text is one line."""


def is_stream(path: Path | None) -> bool:
    """Whether the path is a file that begins as a stream does."""
    if path is None or not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


class Spool(ImageSource):
    """An `ImageSource` of the received images. All messages are kept in a temporary file until `close`.

    Frames are named after the sender's frame numbers.

    Args:
        hello: The HELLO message, with camera and image encoding.
        source: Settings of the images.

    Attributes:
        hello: As the argument.
        stream: File of the messages, as they were received.
        undistorter: Undistorter of the images.
        reader: Reads and undistorts the images.

    Raises:
        InputError: If the settings do not fit the camera.
    """

    def __init__(self, hello: Hello, source: SourceSettings) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="modp-ti-server-")
        self.stream = Path(self._folder.name, "stream.modp")
        super().__init__(self.stream)
        self.hello = hello
        self.intrinsics = hello.intrinsics
        self._size = (hello.intrinsics.camera.width, hello.intrinsics.camera.height)
        # `auto` keeps the images' size, since their sender chooses it.
        self.scale = 1.0 if source.scale == "auto" else source.scale
        self.undistorter = hello.intrinsics.undistorter(self.scale)
        self.reader = FrameReader(self, source)
        self._encoding = hello.encoding
        self._file = self.stream.open("w+b", buffering=0)
        self._end = 0  # size of the file in bytes
        self._images: dict[str, tuple[int, int]] = {}  # place and size in the file
        self._arrived: dict[str, float] = {}
        self._last: tuple[str, NDArray[np.uint8]] | None = None

    def keep(self, kind: Kind, payload: bytes) -> int:
        """Add a message to the file; return the place of its payload. Raises SpoolFullError if there is no space."""
        message = encoded(kind, payload)
        try:
            if not has_room(self.stream.parent, len(message)):
                where = self.stream.parent.parent
                raise SpoolFullError(f"{where}: less than 1 GiB is free for the frames that arrive; set TMPDIR")
            os.pwrite(self._file.fileno(), message, self._end)
        except OSError as error:
            where = self.stream.parent.parent
            raise SpoolFullError(f"{where}: a frame cannot be kept: {error.strerror}; set TMPDIR") from None
        place = self._end + HEADER.size
        self._end += len(message)
        return place

    def add(self, frame: Frame) -> str:
        """Take in the image of a FRAME that is in the file, and return its name.

        Raises:
            UnfitError: If the image does not match HELLO or does not decode.
        """
        name, what = self.name(frame.number), f"FRAME {frame.number}"
        problem = self._mismatch(frame.image)
        if problem is None:
            try:
                self._last = name, self._decode(name, frame.image)
            except InputError as error:
                problem = str(error)
        if problem is not None:
            raise UnfitError(f"{what}: {problem}", frame.number)
        self._images[name] = frame.place + FRAME.size + len(frame.points) * POINT.itemsize, len(frame.image)
        self._arrived[name] = time.monotonic()
        self._append(name, frame.timestamp)
        return name

    def points(self, place: int) -> SparsePoints:
        """Read again the points of the FRAME or POSE whose payload is at this place in the file."""
        count = FRAME.unpack(self._read(place, FRAME.size))[-2]
        return parse_points(self._read(place + FRAME.size, count * POINT.itemsize), "the stream")

    def arrived(self, name: str) -> float:
        """Return `time.monotonic()` when the frame was received [s]."""
        return self._arrived[name]

    def name(self, number: int) -> str:
        """Return the name of the frame with this number."""
        suffix = {Encoding.JPEG: "jpg", Encoding.PNG: "png"}.get(self._encoding, self._encoding.name.lower())
        return f"{number:06d}.{suffix}"

    def _mismatch(self, image: bytes) -> str | None:
        """Say how an image differs from HELLO, by its header, so that no image of another size is ever decoded."""
        width, height = self.frame_size
        if self._encoding.channels is not None:
            wanted = width * height * self._encoding.channels
            return None if len(image) == wanted else f"its image has {len(image)} bytes, HELLO says {wanted}"
        start = b"\xff\xd8" if self._encoding is Encoding.JPEG else b"\x89PNG"
        if not image.startswith(start):
            return f"its image is no {self._encoding.name}"
        try:
            header = decodable(image)
        except OSError as error:
            return f"its {self._encoding.name} image cannot be decoded: {error}"
        fits = (header.width, header.height) == (width, height)
        return None if fits else f"its image is {header.width}x{header.height}, HELLO says {width}x{height}"

    def find(self, name: str) -> str | None:
        return name if name in self._position else None

    def selected(self, start: int, stop: int | None, step: int) -> Sequence[str]:
        return self._names[start:stop:step]

    def read(self, name: str) -> NDArray[np.uint8]:
        """Read an image (H, W, 3); see `ImageSource`. Raises InputError if it does not decode."""
        return np.ascontiguousarray(self._decoded(name)[..., :3])

    def valid(self, name: str) -> NDArray[np.bool_] | None:
        """Mask (H, W) of the pixels whose alpha is not 0; None if the image has no alpha channel."""
        if self._encoding not in (Encoding.PNG, Encoding.RGBA8):
            return None
        image = self._decoded(name)
        return None if image.shape[2] == 3 else image[..., 3] > 0

    def _decoded(self, name: str) -> NDArray[np.uint8]:
        """Image (H, W, 3 or 4) uint8, RGB first. The last one is cached, since it is decoded to check it first."""
        last = self._last  # another thread may replace it
        if last is None or last[0] != name:
            if name not in self._images:
                raise InputError(f"{name}: no such frame was received")
            self._last = last = name, self._decode(name, self._read(*self._images[name]))
        return last[1]

    def _decode(self, name: str, data: bytes) -> NDArray[np.uint8]:
        width, height = self.frame_size
        if self._encoding.channels is not None:
            image = np.frombuffer(data, np.uint8).reshape(height, width, self._encoding.channels)
            return np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image
        # Same flags as ImageFolder for JPEG. PNG keeps its alpha channel.
        png = self._encoding is Encoding.PNG
        image = decoded_as(data, cv2.IMREAD_UNCHANGED if png else cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None or image.dtype != np.uint8:
            raise InputError(f"{name}: its {self._encoding.name} image is damaged or not of 8 bits a channel")
        channels = image.shape[2] if image.ndim == 3 else 1
        conversion = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}[channels]
        return np.asarray(cv2.cvtColor(image, conversion), dtype=np.uint8)

    def _read(self, place: int, size: int) -> bytes:
        data = os.pread(self._file.fileno(), size, place)
        if len(data) < size:
            raise InputError(f"{self.stream}: what was kept there is gone")
        return data

    def close(self) -> None:
        """Delete the temporary file."""
        self._file.close()
        self._folder.cleanup()
