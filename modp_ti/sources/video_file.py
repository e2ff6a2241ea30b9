"""Source `video`: the frames of a video file, through OpenCV."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from modp_ti.errors import InputError
from modp_ti.sources.image_bounds import MAX_IMAGE_PIXELS
from modp_ti.sources.known_frames import KnownFrames
from modp_ti.sources.video_container import missing_bytes

if TYPE_CHECKING:
    import cv2

__all__ = ["VIDEO_SUFFIXES", "VideoFile", "quiet_decoder"]

VIDEO_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts"),
    *(".wmv", ".flv", ".3gp", ".ogv", ".h264", ".h265", ".hevc", ".mjpg", ".mjpeg"),
)

# Up to this many frames ahead are decoded and passed over; further ones are sought, which decodes from the last
# keyframe of the stream, some 250 frames away at most.
PASSED_OVER = 60
# Before this time [ms] the decoder is asked to go, for a frame to come after the place where it lands.
SEEK_MARGIN = 100.0


class VideoFile(KnownFrames):
    """An `ImageSource` of a video file. Frame n, from 0, is called `<file's name without suffix>_<n with six digits>`.

    The file is decoded once when it is opened, as only that tells how many frames it has and when they are shown;
    with `stop`, up to there. Frames are turned as the file asks (phones record portraits lying). Times are the
    container's; fps: where it has none.

    A frame is the same whenever and in whatever order it is read: new ones come from a decoder that goes forward from
    the first, older ones from a second one, which seeks, and whose frames are compared with a checksum of the first
    reading. May be read from several threads.

    Raises InputError for a file that is missing, no video, without a frame, or cut off before `stop`.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float = 30.0, stop: int | None = None) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise InputError(f"{self.path}: no such video file (source.path)")
        if not self.path.is_file():
            raise InputError(f"{self.path}: a video must be a file, this is a folder or a pipe (source.kind)")
        try:
            missing = missing_bytes(self.path)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be opened: {error.strerror}") from None
        self._lock = Lock()
        self._checksums: dict[int, int] = {}
        self._seeks = True
        self._front = self._decoder(missing, in_threads=True)
        self._back: _Decoder | None = None

        shown: list[float] = []
        while (stop is None or len(shown) < stop) and self._front.advance():
            shown.append(self._front.shown)
            if len(shown) == 1:
                first = self._front.image()
        cut_off = bool(missing) and (stop is None or len(shown) < stop)
        if not shown or first is None or cut_off:
            self.close()
        if not shown or first is None:
            raise self._useless(missing)
        if cut_off:
            raise InputError(
                f"{self.path}: the video is cut off, {missing} bytes are missing: copy it again, or set source.stop: "
                f"{len(shown)} to use the frames that can be read"
            )
        self._shown = np.array(shown)
        times, timed = _frame_times(self._shown, fps)
        super().__init__(self.path, [f"{self.path.stem}_{i:06d}" for i in range(len(shown))], times)

        height, width = first.shape[:2]
        self._size = (width, height)
        if self._front.turned:
            self.add_note(
                f"{self.path} asks to be turned clockwise by {self._front.turned} degrees, and is: its frames are "
                f"{width}x{height}, and intrinsics are for that"
            )
        if not timed:
            self.add_note(f"{self.path} holds no frame times: frame n is taken to be of second n / {fps:g}")
        self._front.close()
        self._front = self._decoder(missing)

    def size(self, name: str) -> tuple[int, int]:
        """(width, height) of the frames."""
        assert name in self._position, name
        return self._size

    def read(self, name: str) -> NDArray[np.uint8]:
        """Decoded frame (H, W, 3) uint8 RGB. Raises InputError where it cannot be decoded."""
        import cv2

        with self._lock:
            index = self._position[name]
            image = self._new(index) if index > self._front.index else self._old(index)
        if image is None:
            raise InputError(f"{self.path}: frame {index} cannot be decoded (any more); was the file changed?")
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def close(self) -> None:
        """Close the file."""
        for decoder in (self._front, self._back):
            if decoder is not None:
                decoder.close()

    def _new(self, index: int) -> NDArray[np.uint8] | None:
        """A frame behind all that were read: decoding goes on to there."""
        if not self._front.advance_to(index):
            return None
        image = self._front.image()
        if image is not None:
            self._checksums[index] = _checksum(image)
        return image

    def _old(self, index: int) -> NDArray[np.uint8] | None:
        """A frame from before the front, checked against its checksum where it was read then."""
        known = self._checksums.get(index)
        if self._back is None:
            self._back = self._decoder()
        ahead = index - self._back.index
        if not 0 < ahead <= PASSED_OVER and known is not None and self._seeks and self._seek(index):
            image = self._back.image()
            if image is not None and _checksum(image) == known:
                return image
            self._seeks = False  # this container's times do not find frames
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
            self._seeks = False  # frames were lost behind a place that was sought
            return self._old(index)
        return image

    def _seek(self, index: int) -> bool:
        """Whether the second decoder stands at the frame after a search by its time."""
        assert self._back is not None
        margin = SEEK_MARGIN
        while margin < 1e5:
            target = max(float(self._shown[index]) - margin, 0.0)
            landed = self._back.seek(target)
            found = None if landed is None else np.flatnonzero(self._shown == landed)
            if found is not None and len(found) == 1 and found[0] <= index:
                self._back.index = int(found[0])
                return self._back.index == index or self._back.advance_to(index)
            if target == 0.0:
                break
            margin *= 4
        self._back.index = len(self.names)  # somewhere: what comes next begins anew
        return False

    def _decoder(self, missing: int | None = None, in_threads: bool = False) -> _Decoder:
        try:
            return _Decoder(self.path, in_threads)
        except OSError:
            raise self._useless(missing) from None

    def _useless(self, missing: int | None) -> InputError:
        if self.path.stat().st_size == 0:
            return InputError(f"{self.path}: the video file is empty")
        if missing:
            return InputError(f"{self.path}: the video is cut off, {missing} bytes are missing: copy it again")
        return InputError(
            f"{self.path}: no video that OpenCV can read, or without a frame: convert it, for example with "
            "`ffmpeg -i in -c:v libx264 out.mp4`"
        )


class _Decoder:
    """A capture that counts. index: of the frame that was decoded last, -1 before the first.

    in_threads: faster, but damaged parts of a stream then look different each time.
    """

    def __init__(self, path: Path, in_threads: bool) -> None:
        import cv2

        with quiet_decoder():
            threads = [] if in_threads else [cv2.CAP_PROP_N_THREADS, 1]
            self._capture: cv2.VideoCapture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, threads)
            # Where OpenCV was built without FFmpeg; its other readers write to the terminal.
            if not self._capture.isOpened() and cv2.CAP_FFMPEG not in cv2.videoio_registry.getBackends():
                self._capture = cv2.VideoCapture(str(path))
        if not self._capture.isOpened():
            raise OSError(str(path))
        sides = [self._capture.get(side) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        if sides[0] * sides[1] > MAX_IMAGE_PIXELS:
            self._capture.release()
            raise OSError(str(path))
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        self.turned = int(self._capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360
        self.index = -1

    @property
    def shown(self) -> float:
        """When the frame is shown [ms], as the container says."""
        import cv2

        return float(self._capture.get(cv2.CAP_PROP_POS_MSEC))

    def advance(self) -> bool:
        """Decode the next frame; False at the end."""
        more = bool(self._capture.grab())
        self.index += more
        return more

    def advance_to(self, index: int) -> bool:
        while self.index < index:
            if not self.advance():
                return False
        return self.index == index

    def seek(self, milliseconds: float) -> float | None:
        """Go to about this time and decode a frame: its time, None where there is none. `index` is unknown then."""
        import cv2

        self._capture.set(cv2.CAP_PROP_POS_MSEC, milliseconds)
        return self.shown if self.advance() else None

    def image(self) -> NDArray[np.uint8] | None:
        """The frame that was decoded last (H, W, 3), BGR; None where it is unusable."""
        more, image = self._capture.retrieve()
        return image if more else None

    def close(self) -> None:
        self._capture.release()


@contextmanager
def quiet_decoder() -> Iterator[None]:
    """Keeps OpenCV and its FFmpeg from writing to the terminal: the one line that the user gets is ours."""
    import cv2

    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when the first video is opened
    log_level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(log_level)


def _frame_times(shown: NDArray[np.float64], fps: float) -> tuple[NDArray[np.float64], bool]:
    """Times [s] that increase, of the times [ms] that a container says; and whether they are the container's.

    Some containers leave the last frames without one: they follow at the usual distance.
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
    return zlib.crc32(np.ascontiguousarray(image))
