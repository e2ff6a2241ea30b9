"""The images of a capture as an image source."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.inputs.captures import read_capture
from modp_ti.inputs.captures.capture import Capture
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.listed_images import ListedImages
from modp_ti.inputs.sources.protocol import ImageSource
from modp_ti.inputs.sources.undistortion import both_valid
from modp_ti.inputs.sources.video_file import VideoFile

__all__ = ["CaptureImages", "open_capture_images"]


class CaptureImages(ListedImages):
    """The images of a capture in files, in a folder or an archive.

    Args:
        capture: The capture.
    """

    def __init__(self, capture: Capture) -> None:
        frames = capture.frames
        super().__init__(
            capture.tree.path, [frame.image for frame in frames], [frame.time for frame in frames], notes=capture.notes
        )
        self.capture = capture

    def _open(self, name: str) -> BinaryIO:
        return io.BytesIO(self._content(name))

    def _content(self, name: str) -> bytes:
        assert self.capture is not None
        return self.capture.tree.read(name)

    def valid(self, name: str) -> NDArray[np.bool_] | None:
        assert self.capture is not None
        border = self.capture.border
        seen = super().valid(name)
        if not border:
            return seen
        width, height = self.size(name)
        mask = np.zeros((height, width), dtype=bool)
        mask[border:-border, border:-border] = True
        return both_valid(mask, seen)

    def close(self) -> None:
        assert self.capture is not None
        self.capture.tree.close()


def open_capture_images(path: Path, kind: str, fps: float, stop: int | None) -> ImageSource:
    """Open the images of a capture. Their camera is that of the first, for trackers that track them anew.

    Args:
        path: The capture.
        kind: Its kind.
        fps: Images per second, for a video without times.
        stop: Number of images to use, for a video; all if None.

    Raises:
        InputError: If there is no such capture, or it is malformed.
    """
    capture = read_capture(path, kind)
    if not capture.frames:
        raise InputError(f"{path}: has no frame that could be used")
    first = capture.frames[0]
    if not capture.video:
        images: ImageSource = CaptureImages(capture)
        images.intrinsics = Intrinsics(first.camera, first.lens)
        return images
    images = VideoFile(capture.tree.path / capture.video, fps, stop)
    count, posed = len(images.names), len(capture.frames)
    size = images.frame_size
    frames = [
        replace(frame, image=name, camera=frame.camera.resized(*size))
        for frame, name in zip(capture.frames, images.names, strict=False)
    ]
    for note in capture.notes:
        images.add_note(note)
    if count < posed and stop is None:
        images.add_note(
            f"{capture.video} has {count} frames, {capture.origin} {posed} rows: the last rows are left out"
        )
    images.capture = replace(capture, frames=frames)
    images.intrinsics = Intrinsics(frames[0].camera, first.lens)
    return images
