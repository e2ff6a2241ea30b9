"""Storage of received images and points on disk, so that frames can be read again."""

from __future__ import annotations

import io
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints
from fields.runtime.process import has_room
from modp_ti.config.settings import SourceSettings
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources import FrameReader
from modp_ti.inputs.sources.image_header import read_image_header, why_undecodable
from modp_ti.inputs.sources.image_pixels import decoded_as
from modp_ti.inputs.sources.protocol import ImageSource
from modp_ti.inputs.tracker_server.messages import (
    FRAME,
    POINT,
    Encoding,
    Frame,
    Hello,
    Kind,
    UnfitError,
    encoded,
    parse_points,
)
from modp_ti.inputs.tracker_server.recorded_stream import FRAMES, STREAM

if TYPE_CHECKING:
    from modp_ti.config.settings import SourceSettings


class SpoolFullError(Exception):
    """The disk has no space for another frame. The text is one line."""


class Spool(ImageSource):
    """An `ImageSource` of the received images, stored in a temporary folder until `close`.

    Frames are named after the sender's frame numbers.

    Args:
        hello: The HELLO message, with camera and image encoding.
        source: Settings of the images.

    Attributes:
        hello: As the argument.
        stream: File of the messages, see `recorded_stream`.
        undistorter: Undistorter of the images.
        reader: Reads and undistorts the images.

    Raises:
        InputError: If the settings do not fit the camera.
    """

    def __init__(self, hello: Hello, source: SourceSettings) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="modp-ti-server-")
        frames = Path(self._folder.name, FRAMES)
        frames.mkdir()
        super().__init__(frames)
        self.hello = hello
        self.intrinsics = hello.intrinsics
        self._size = (hello.intrinsics.camera.width, hello.intrinsics.camera.height)
        # `auto` keeps the images' size, since their sender chooses it.
        self.scale = 1.0 if source.scale == "auto" else source.scale
        self.undistorter = hello.intrinsics.undistorter(self.scale)
        self.reader = FrameReader(self, source)
        self._encoding = hello.encoding
        self.stream = self.path.with_name(STREAM)
        self._stream = self.stream.open("wb", buffering=0)
        self._last: tuple[str, NDArray[np.uint8]] | None = None
        self._received: dict[str, float] = {}

    def keep(self, kind: Kind, payload: bytes) -> None:
        """Add a message to the file of the stream. Raises SpoolFullError if the disk has no space."""
        message = encoded(kind, payload)
        if kind is Kind.FRAME:
            message = message[: -FRAME.unpack_from(payload)[-1] or None]
        try:
            self._stream.write(message)
        except OSError as error:
            raise self._full(error) from None

    def add(self, frame: Frame) -> str:
        """Store a frame's image.

        Returns:
            The name of the frame.

        Raises:
            UnfitError: If the image does not match HELLO or does not decode.
            SpoolFullError: If the disk has no space.
        """
        self._require_image(frame)
        name = self.name(frame.number)
        self._write(name, frame.image)
        try:
            self._decoded(name)
        except InputError as error:
            (self.path / name).unlink(missing_ok=True)
            raise UnfitError(f"FRAME {frame.number}: {error}", frame.number) from None
        self._received[name] = time.monotonic()
        self._append(name, frame.timestamp)
        return name

    def received(self, name: str) -> float:
        """`time.monotonic()` when the frame was received [s]."""
        return self._received[name]

    def arrived(self, name: str) -> float | None:
        return self.received(name)

    def name(self, number: int) -> str:
        """The name of the frame with this number."""
        return self._encoding.file(number)

    def _require_image(self, frame: Frame) -> None:
        """Check encoding and size from the image's header, so that no image of another size is ever decoded."""
        width, height = self.frame_size
        what = f"FRAME {frame.number}"
        if self._encoding.channels is not None:
            wanted = width * height * self._encoding.channels
            if len(frame.image) != wanted:
                raise UnfitError(f"{what}: its image has {len(frame.image)} bytes, HELLO says {wanted}", frame.number)
            return
        start = b"\xff\xd8" if self._encoding is Encoding.JPEG else b"\x89PNG"
        header = read_image_header(io.BytesIO(frame.image)) if frame.image.startswith(start) else None
        if header is None:
            raise UnfitError(f"{what}: its image is no {self._encoding.name}", frame.number)
        if not header.complete:
            raise UnfitError(f"{what}: its {self._encoding.name} image is cut off", frame.number)
        if (header.width, header.height) != (width, height):
            raise UnfitError(
                f"{what}: its image is {header.width}x{header.height}, HELLO says {width}x{height}",
                frame.number,
            )
        if self._encoding is Encoding.JPEG and (reason := why_undecodable(frame.image)) is not None:
            raise UnfitError(f"{what}: {reason}", frame.number)

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
            self._last = last = name, self._decode(name)
        return last[1]

    def _decode(self, name: str) -> NDArray[np.uint8]:
        width, height = self.frame_size
        try:
            data = (self.path / name).read_bytes()
        except OSError as error:
            raise InputError(f"{self.path / name}: the frame that was kept there is gone: {error.strerror}") from None
        if self._encoding.channels is not None:
            image = np.frombuffer(data, np.uint8).reshape(height, width, self._encoding.channels)
            return np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image
        import cv2

        # Same flags as ImageFolder for JPEG. PNG keeps its alpha channel.
        png = self._encoding is Encoding.PNG
        image = decoded_as(data, cv2.IMREAD_UNCHANGED if png else cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None or image.dtype != np.uint8:
            raise InputError(f"{name}: its {self._encoding.name} image is damaged or not of 8 bits a channel")
        channels = image.shape[2] if image.ndim == 3 else 1
        conversion = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}[channels]
        return np.asarray(cv2.cvtColor(image, conversion), dtype=np.uint8)

    def keep_points(self, name: str, points: SparsePoints) -> None:
        """Store the points of a delivered frame. Raises SpoolFullError if the disk has no space."""
        table = np.zeros(len(points), dtype=POINT)
        table["id"], table["xyz"], table["pixel"] = points.ids, points.xyz, points.pixels
        self._write(name + ".points", table.tobytes())

    def points(self, name: str) -> SparsePoints:
        """Read the stored points of a frame."""
        return parse_points((self.path / (name + ".points")).read_bytes(), name)

    def _write(self, name: str, data: bytes) -> None:
        try:
            if not has_room(self.path, len(data)):
                raise SpoolFullError(
                    f"{self.path.parent.parent}: less than 1 GiB is free for the frames that arrive; set TMPDIR"
                )
            (self.path / name).write_bytes(data)
        except OSError as error:
            raise self._full(error) from None

    def _full(self, error: OSError) -> SpoolFullError:
        return SpoolFullError(f"{self.path.parent.parent}: a frame cannot be kept: {error.strerror}; set TMPDIR")

    def close(self) -> None:
        """Delete the temporary folder."""
        self._stream.close()
        self._folder.cleanup()
