"""Source `live`: a camera or a network stream, through OpenCV, frame by frame as they come.

Not through PyAV, as `video_file`: OpenCV finds cameras by number with the drivers of each operating system.
"""

from __future__ import annotations

import atexit
import os
import re
import signal
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.known_frames import find_frame
from modp_ti.inputs.sources.listed_images import decoded
from modp_ti.inputs.sources.protocol import ImageSource

__all__ = ["LiveSource"]

# Frames that wait to be taken: a second of hesitation at 8 frames a second. Of more, the oldest are dropped.
WAITING = 8
# A stream that sends nothing for so long [s] has ended, and one that does not open within it is not there.
PATIENCE = 10.0


class LiveSource(ImageSource):
    """A source that is still being taken. Frame n that was delivered is called `live_<n with six digits>`.

    stream: number of a camera, or URL. A thread takes frames from it all the time; up to `WAITING` wait to be asked
    for by `arriving`, and of more the oldest are dropped and counted. A frame that is delivered is written, without
    loss, into a temporary folder, from which it is read again; `close` removes it. Times are those of arrival, in
    seconds of the Unix clock.

    It ends when the stream does, when `arriving` comes to its `stop`, with `finish`, and with the first Ctrl-C (where
    it was opened in the main thread): the frames until then are all there are. After the end Ctrl-C interrupts.

    Raises InputError where the stream cannot be opened or sends no frame.
    """

    def __init__(self, stream: int | str) -> None:
        if isinstance(stream, str) and stream.isdigit():
            stream = int(stream)
        super().__init__(Path(_shown(stream)))
        self.dropped = 0
        self._names: list[str] = []
        self._position: dict[str, int] = {}
        self._times: list[float] = []
        self._waiting: deque[tuple[float, NDArray[np.uint8]]] = deque()
        self._changed = threading.Condition()
        self._delivering = threading.Lock()
        self._ended = False
        self._capture = _open(stream)
        # The clock of the computer may be set while frames come; distances between them are those of a steady one.
        self._clock = time.time() - time.monotonic()
        first = self._grab()
        if first is None:
            self._capture.release()
            raise InputError(f"{self.path}: sends no frame (source.stream); is it in use by another program?")
        self._frame_size = (first[1].shape[1], first[1].shape[0])
        self._waiting.append(first)
        self._kept = tempfile.TemporaryDirectory(prefix="modp-ti-live-", ignore_cleanup_errors=True)
        # A daemon, so that a stalled stream does not hold the process; and an end before Python's own, which would
        # break the thread off inside the decoder.
        self._thread = threading.Thread(target=self._take, name=f"frames of {self.path}", daemon=True)
        self._thread.start()
        atexit.register(self.close)
        self._interrupt = None
        if threading.current_thread() is threading.main_thread():
            self._interrupt = signal.signal(signal.SIGINT, self._interrupted)

    @property
    def notes(self) -> list[str]:
        notes = [
            f"{self.path} is mapped live: Ctrl-C ends the recording, and the map is finished with what came",
            *self._notes,
        ]
        if self.dropped:
            notes.append(
                f"{self.dropped} frames of {self.path} came faster than they were taken and were dropped; "
                f"{len(self._names)} were used"
            )
        return notes

    @property
    def names(self) -> Sequence[str]:
        """Of the frames that were delivered so far."""
        return self._names

    def position(self, name: str) -> int:
        """Number of the frame among those delivered, from 0."""
        return self._position[name]

    def timestamp(self, name: str) -> float:
        """When the frame arrived [s], on the Unix clock."""
        return self._times[self._position[name]]

    def find(self, name: str) -> str | None:
        """The frame of that name, whatever folders before it and image suffix behind it; None for any other name."""
        return find_frame(name, self._position)

    def selected(self, start: int, stop: int | None, step: int) -> Sequence[str]:
        """Of the frames so far, those at positions start, start + step, ... before stop.

        Raises InputError where that is none, as it is before any frame has been taken.
        """
        names = self._names[start:stop:step]
        if not names:
            raise InputError(f"{self.path}: a live source has no past frames: take a tracker that follows it")
        return names

    def arriving(self, start: int, stop: int | None, step: int) -> Iterator[str]:
        """Names at positions start, start + step, ... before stop, as soon as each frame is there."""
        position = start
        while stop is None or position < stop:
            if not self._delivered(position):
                return
            yield self._names[position]
            position += step
        self.finish()

    @property
    def frame_size(self) -> tuple[int, int]:
        return self._frame_size

    def size(self, name: str) -> tuple[int, int]:
        """(width, height) of the stream's frames."""
        assert name in self._position, name
        return self._frame_size

    def read(self, name: str) -> NDArray[np.uint8]:
        """The frame (H, W, 3) uint8 RGB, exactly as it came. Raises InputError where it cannot be read again."""
        file = self._file(self._position[name])
        try:
            image = decoded(file.read_bytes())
        except OSError:
            image = None
        if image is None:
            raise InputError(f"{file}: the frame that was kept there is gone or damaged: leave the folder alone")
        return image

    def finish(self) -> None:
        """Take no more frames; those that wait are dropped."""
        with self._changed:
            self._ended = True
            self._waiting.clear()
            self._changed.notify_all()

    def close(self) -> None:
        """End the thread, let the camera go and remove the frames that were kept."""
        self.finish()
        # A thread that waits for a stream which has stalled ends when it is tired of that; nothing depends on it.
        self._thread.join(1.0)
        self._give_back_interrupt()
        self._kept.cleanup()
        atexit.unregister(self.close)

    def _grab(self) -> tuple[float, NDArray[np.uint8]] | None:
        """The next frame (BGR) with the time of its arrival; None at the end of the stream."""
        import cv2

        try:
            more = self._capture.grab()
            arrived = time.monotonic()
            more, image = self._capture.retrieve() if more else (False, None)
        except cv2.error:
            return None
        return (self._clock + arrived, image) if more else None

    def _take(self) -> None:
        """What the thread does until the end."""
        while not self._ended:
            frame = self._grab()
            with self._changed:
                if frame is None:
                    self._ended = True
                elif not self._ended:
                    self._waiting.append(frame)
                    if len(self._waiting) > WAITING:
                        self._waiting.popleft()
                        self.dropped += 1
                self._changed.notify_all()
        self._capture.release()

    def _delivered(self, position: int) -> bool:
        """Whether the frame is there, once it is or no more will come."""
        with self._delivering:
            while len(self._names) <= position:
                with self._changed:
                    while not self._waiting and not self._ended:
                        self._changed.wait()
                    if not self._waiting:
                        return False
                    arrived, image = self._waiting.popleft()
                self._keep(arrived, image)
            return True

    def _keep(self, arrived: float, image: NDArray[np.uint8]) -> None:
        import cv2

        number = len(self._names)
        try:
            _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            self._file(number).write_bytes(data)
        except OSError as error:
            raise InputError(
                f"{self._kept.name}: frames of the live source cannot be kept there: {error.strerror}; "
                "make room, or set TMPDIR to a folder that has some"
            ) from None
        name = f"live_{number:06d}"
        self._times.append(arrived)
        self._position[name] = number
        self._names.append(name)

    def _file(self, number: int) -> Path:
        return Path(self._kept.name) / f"{number:06d}.png"

    def _interrupted(self, *_: object) -> None:
        self._give_back_interrupt()
        if self._ended:
            raise KeyboardInterrupt
        # In a thread of its own: the interrupted one may hold the lock.
        threading.Thread(target=self.finish, daemon=True).start()

    def _give_back_interrupt(self) -> None:
        if self._interrupt is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, self._interrupt)
            self._interrupt = None


def _shown(stream: int | str) -> str:
    """The stream as messages call it: no password, and no `//`, which a path would lose."""
    if isinstance(stream, int):
        return f"camera {stream}"
    return re.sub(r"^[a-z0-9+.-]+://(?:[^/@]*@)?", "", stream, flags=re.IGNORECASE).partition("?")[0]


def _open(stream: int | str):
    """The capture. Raises InputError where there is none."""
    import cv2

    if isinstance(stream, str) and Path(stream).is_file():
        raise InputError(f"{stream}: is a file (source.stream): give it as source.path")
    with _quiet_decoder():
        try:
            if isinstance(stream, int) or "://" not in stream:  # a camera, by its number or its path
                capture = cv2.VideoCapture(stream)
            else:
                patience = int(1000 * PATIENCE)
                limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, patience, cv2.CAP_PROP_READ_TIMEOUT_MSEC, patience]
                capture = cv2.VideoCapture(stream, cv2.CAP_FFMPEG, limits)
        except cv2.error:
            capture = None
    if capture is None or not capture.isOpened():
        what = "no such camera, or it is in use" if isinstance(stream, int) else "no stream that can be opened"
        raise InputError(f"{_shown(stream)}: {what} (source.stream)")
    return capture


@contextmanager
def _quiet_decoder() -> Iterator[None]:
    """Keeps OpenCV and its FFmpeg from writing to the terminal: the user gets one line, from us."""
    import cv2

    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when the first stream is opened
    log_level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(log_level)
