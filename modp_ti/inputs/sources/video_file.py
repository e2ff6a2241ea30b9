"""Source `video`: the frames of a video file, readable in any order."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.orientation import AS_STORED
from modp_ti.inputs.sources.protocol import IMAGE_SUFFIXES, ImageSource
from modp_ti.inputs.sources.tone_mapping import PEAK, WHITE
from modp_ti.inputs.sources.video_container import missing_bytes, require_true_index

if TYPE_CHECKING:
    from modp_ti.inputs.sources.video_decoder import VideoDecoder
    from modp_ti.inputs.sources.video_picture import VideoForm

__all__ = ["VIDEO_SUFFIXES", "VideoFile", "is_video"]

VIDEO_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts"),
    *(".wmv", ".flv", ".3gp", ".ogv", ".h264", ".h265", ".hevc", ".mjpg", ".mjpeg"),
    *(".gif", ".insv", ".lrv", ".qt", ".dav", ".y4m"),
)

# Frames up to this many ahead are reached by decoding, farther ones by seeking. A seek decodes from the previous
# keyframe of the stream, usually at most 250 frames back.
PASSED_OVER = 60
# Margins before the wanted frame [s] for seeking. The next one is tried if a seek lands after the frame.
SEEK_MARGINS = (0.0, 1.0, 10.0, 100.0)


class VideoFile(ImageSource):
    """An `ImageSource` of a video file. Frame n, from 0, is called `<file stem>_<n, six digits>`.

    The file is decoded once when it is opened, because only that gives the number of frames and their times. Frames are
    turned as the file requests: phones store portrait videos in landscape. HDR is tone-mapped (`tone_mapping.py`), and
    of interlaced frames one field is used.

    A frame is the same whenever and in whatever order it is read. New frames come from a decoder that runs forward from
    the first frame. Earlier frames come from a second decoder that seeks; each of its frames is compared with a
    checksum from the first reading. Frames may be read from several threads.

    Args:
        path: The video file.
        fps: Frames per second, used if the container has no frame times.
        stop: Number of frames to use; all if None.

    Raises:
        InputError: If the file is missing, not a video, has no frames, or is truncated before `stop`.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float = 30.0, stop: int | None = None) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise InputError(f"{self.path}: no such video file (source.path)")
        if not self.path.is_file():
            raise InputError(f"{self.path}: a video must be a file, this is a folder or a pipe (source.kind)")
        try:
            missing = missing_bytes(self.path)
            require_true_index(self.path)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be opened: {error.strerror}") from None
        self._lock = Lock()
        self._checksums: dict[int, int] = {}
        self._seeks = True
        self._form: VideoForm | None = None
        self._front = self._decoder(missing, in_threads=True)
        self._back: VideoDecoder | None = None

        shown: list[float] = []
        first, interlaced = None, 0
        while (stop is None or len(shown) < stop) and self._front.advance():
            shown.append(self._front.shown)
            interlaced += self._front.interlaced
            if len(shown) == 1:
                first, self._form = self._front.image(), self._front.form
        cut_off = bool(missing) and (stop is None or len(shown) < stop)
        if first is None or self._form is None:
            self.close()
            raise self._useless(missing)
        if cut_off:
            self.close()
            raise InputError(
                f"{self.path}: the video is cut off, {missing} bytes are missing: copy it again, or set source.stop: "
                f"{len(shown)} to use the frames that can be read"
            )
        self._shown = np.array(shown)
        times, timed = _frame_times(self._shown, fps)
        super().__init__(self.path, [f"{self.path.stem}_{i:06d}" for i in range(len(shown))], times)

        height, width = first.shape[:2]
        self._size = (width, height)
        if self._front.choice:
            self.add_note(f"{self.path} {self._front.choice}")
        for note in _form_notes(self._form, width, height, interlaced, len(shown)):
            self.add_note(f"{self.path} {note}")
        if not timed:
            self.add_note(f"{self.path} holds no frame times: frame n is taken to be of second n / {fps:g}")
        self._front.close()
        self._front = self._decoder(missing)

    def read(self, name: str) -> NDArray[np.uint8]:
        """Decode a frame (H, W, 3) uint8 RGB.

        Raises:
            InputError: If the frame cannot be decoded.
        """
        with self._lock:
            index = self._position[name]
            image = self._new(index) if index > self._front.index else self._old(index)
        if image is None:
            raise InputError(f"{self.path}: frame {index} cannot be decoded (any more); was the file changed?")
        return image

    def close(self) -> None:
        """Close the file."""
        for decoder in (self._front, self._back):
            if decoder is not None:
                decoder.close()

    def _new(self, index: int) -> NDArray[np.uint8] | None:
        """Decode a frame after the front decoder's position."""
        if not self._front.advance_to(index):
            return None
        image = self._front.image()
        if image is not None:
            self._checksums[index] = _checksum(image)
        return image

    def _old(self, index: int) -> NDArray[np.uint8] | None:
        """Decode a frame at or before the front decoder's position and compare it with its checksum, if known."""
        known = self._checksums.get(index)
        if self._back is None:
            self._back = self._decoder()
        ahead = index - self._back.index
        if not 0 < ahead <= PASSED_OVER and known is not None and self._seeks and self._seek(index):
            image = self._back.image()
            if image is not None and _checksum(image) == known:
                return image
            self._seeks = False  # seeking by time does not work for this container
        if index <= self._back.index or not self._seeks:
            self._back.close()
            self._back = self._decoder()
        if not self._back.advance_to(index):
            return None
        image = self._back.image()
        if image is None:
            return None
        if known is None:
            self._checksums[index] = _checksum(image)
        elif _checksum(image) != known and self._seeks:
            self._seeks = False  # decoding after a seek has skipped frames
            return self._old(index)
        return image

    def _seek(self, index: int) -> bool:
        """Seek the second decoder to a frame by its time. Returns whether that succeeded."""
        assert self._back is not None
        for margin in SEEK_MARGINS:
            landed = self._back.seek(float(self._shown[index]) - 1000.0 * margin)
            found = [] if landed is None else np.flatnonzero(self._shown == landed)
            if len(found) == 1 and found[0] <= index:
                self._back.index = int(found[0])
                return self._back.advance_to(index)
        self._back.index = len(self.names)  # unknown position: the next read reopens the file
        return False

    def _decoder(self, missing: int | None = None, in_threads: bool = False) -> VideoDecoder:
        from modp_ti.inputs.sources.video_decoder import VideoDecoder

        try:
            return VideoDecoder(self.path, in_threads, self._form)
        except OSError:
            raise self._useless(missing) from None

    def _useless(self, missing: int | None) -> InputError:
        if self.path.stat().st_size == 0:
            return InputError(f"{self.path}: the video file is empty")
        if missing:
            return InputError(f"{self.path}: the video is cut off, {missing} bytes are missing: copy it again")
        return InputError(
            f"{self.path}: no video that FFmpeg can read, or without a frame: convert it, for example with "
            "`ffmpeg -i in -c:v libx264 out.mp4`"
        )


def is_video(path: Path) -> bool:
    """Whether FFmpeg finds a video in a file, whatever its suffix. A single picture is none."""
    from modp_ti.inputs.sources.video_decoder import VideoDecoder

    try:
        if path.suffix.lower() in IMAGE_SUFFIXES:
            return False
        VideoDecoder(path, in_threads=False).close()
    except OSError:
        return False
    return True


def _form_notes(form: VideoForm, width: int, height: int, interlaced: int, count: int) -> Iterator[str]:
    """Yield what is done to the frames.

    Args:
        form: What the frames have in common.
        width: Width of the pictures [px].
        height: Height of the pictures [px].
        interlaced: Number of interlaced frames.
        count: Number of frames.
    """
    if form.turn != AS_STORED:
        yield f"asks to be {form.turn}, and is: its frames are {width}x{height}, and intrinsics are for that"
    if form.slant:
        yield f"asks to be turned clockwise by {form.slant} degrees more, which is not done: only quarter turns are"
    if form.transfer is not None:
        yield (
            f"is HDR ({form.transfer.name}, BT.2020): its colours are converted to BT.709, and {PEAK:g} cd/m2 become a "
            f"white of {WHITE:g} cd/m2 by the curve of BT.2390"
        )
    if interlaced:
        yield (
            f"is interlaced ({interlaced} of {count} frames): of such a frame, the upper field is used, and the lines "
            "between are interpolated"
        )


def _frame_times(shown: NDArray[np.float64], fps: float) -> tuple[NDArray[np.float64], bool]:
    """Compute increasing frame times [s] from a container's time stamps [ms].

    Some containers have no time stamps for the last frames. Those follow at the median distance.

    Returns the times, and whether they come from the container rather than from `fps`.
    """
    falls = np.flatnonzero(np.diff(shown) <= 0)
    good = int(falls[0]) + 1 if len(falls) else len(shown)
    if good < max(len(shown) - 32, min(2, len(shown))):
        return np.arange(len(shown)) / fps, False
    times = shown / 1000.0
    distance = float(np.median(np.diff(times[:good]))) if good > 1 else 1.0 / fps
    times[good:] = times[good - 1] + distance * np.arange(1, len(shown) - good + 1)
    return times, True


def _checksum(image: NDArray[np.uint8]) -> int:
    return zlib.crc32(np.ascontiguousarray(image).data)
