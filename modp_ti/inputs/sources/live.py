"""Source `live`: a camera or a network stream, read with OpenCV as frames arrive.

`video_file` uses PyAV. Live sources use OpenCV because it finds cameras by number on every operating system.
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
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.listed_images import decoded, quiet_opencv
from modp_ti.inputs.sources.protocol import ImageSource

__all__ = ["LiveSource"]

# Capacity of the queue of arrived frames: one second at 8 frames per second. If it is full, the oldest are dropped.
WAITING = 8
# Timeout of a network stream [s], for opening it and for each frame.
PATIENCE = 10.0


class LiveSource(ImageSource):
    """A source that is still recording. The n-th delivered frame is called `live_<n, six digits>`.

    A thread captures frames continuously. Up to `WAITING` frames are queued for `arriving`; if more arrive, the oldest
    are dropped and counted. Each delivered frame is stored without loss in a temporary folder, from which `read`
    decodes it again; `close` removes the folder. Times are those of arrival [s], on the Unix clock.

    The recording ends when the stream ends, when `arriving` reaches its `stop`, when `finish` is called, or on the
    first Ctrl-C if the source was opened in the main thread. After that, Ctrl-C interrupts as usual.

    Args:
        stream: Number of a camera, or URL.

    Attributes:
        dropped: Number of dropped frames.

    Raises:
        InputError: If the stream cannot be opened or sends no frame.
    """

    def __init__(self, stream: int | str) -> None:
        if isinstance(stream, str) and stream.isdigit():
            stream = int(stream)
        super().__init__(Path(_shown(stream)))
        self.dropped = 0
        self._waiting: deque[tuple[float, NDArray[np.uint8]]] = deque()
        self._changed = threading.Condition()
        self._delivering = threading.Lock()
        self._ended = False
        self._capture = _open(stream)
        # The system clock may be adjusted during the recording, so times advance with the monotonic clock.
        self._clock = time.time() - time.monotonic()
        first = self._grab()
        if first is None:
            self._capture.release()
            raise InputError(f"{self.path}: sends no frame (source.stream); is it in use by another program?")
        self._size = (first[1].shape[1], first[1].shape[0])
        self._waiting.append(first)
        self._kept = tempfile.TemporaryDirectory(prefix="modp-ti-live-", ignore_cleanup_errors=True)
        # A daemon, so that a stalled stream does not keep the process alive. `close` is registered with atexit because
        # Python would otherwise kill the thread inside the decoder at shutdown.
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

    def selected(self, start: int, stop: int | None, step: int) -> Sequence[str]:
        """Return the names of delivered frames; see `ImageSource`. There are none before the first is delivered."""
        names = self._names[start:stop:step]
        if not names:
            raise InputError(f"{self.path}: a live source has no past frames: take a tracker that follows it")
        return names

    def arriving(self, start: int, stop: int | None, step: int) -> Iterator[str]:
        """Yield the names at positions start, start + step, ... before stop, as soon as each frame has arrived."""
        position = start
        while stop is None or position < stop:
            if not self._delivered(position):
                return
            yield self._names[position]
            position += step
        self.finish()

    def read(self, name: str) -> NDArray[np.uint8]:
        """Read a delivered frame (H, W, 3) uint8 RGB, exactly as it arrived.

        Raises:
            InputError: If the stored frame is missing or damaged.
        """
        file = self._file(self._position[name])
        try:
            image = decoded(file.read_bytes())
        except OSError:
            image = None
        if image is None:
            raise InputError(f"{file}: the frame that was kept there is gone or damaged: leave the folder alone")
        return image

    def finish(self) -> None:
        """End the recording. Queued frames are dropped."""
        with self._changed:
            self._ended = True
            self._waiting.clear()
            self._changed.notify_all()

    def close(self) -> None:
        """End the recording, release the camera and remove the stored frames."""
        self.finish()
        # If the stream has stalled, the thread ends after its own timeout. Nothing depends on it.
        self._thread.join(1.0)
        self._give_back_interrupt()
        self._kept.cleanup()
        atexit.unregister(self.close)

    def _grab(self) -> tuple[float, NDArray[np.uint8]] | None:
        """Capture the next frame (BGR) with its time of arrival; None at the end of the stream."""
        import cv2

        try:
            more = self._capture.grab()
            arrived = time.monotonic()
            more, image = self._capture.retrieve() if more else (False, None)
        except cv2.error:
            return None
        return (self._clock + arrived, np.asarray(image, dtype=np.uint8)) if more else None

    def _take(self) -> None:
        """Capture frames until the recording ends; runs in the thread."""
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
        """Wait until the frame at `position` is delivered or the recording has ended; return whether it exists."""
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
            self._file(number).write_bytes(data.tobytes())
        except OSError as error:
            raise InputError(
                f"{self._kept.name}: frames of the live source cannot be kept there: {error.strerror}; "
                "make room, or set TMPDIR to a folder that has some"
            ) from None
        self._append(f"live_{number:06d}", arrived)

    def _file(self, number: int) -> Path:
        return Path(self._kept.name) / f"{number:06d}.png"

    def _interrupted(self, *_: object) -> None:
        self._give_back_interrupt()
        if self._ended:
            raise KeyboardInterrupt
        # In a separate thread, because the interrupted one may hold the lock.
        threading.Thread(target=self.finish, daemon=True).start()

    def _give_back_interrupt(self) -> None:
        if self._interrupt is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, self._interrupt)
            self._interrupt = None


def _shown(stream: int | str) -> str:
    """Return the stream's name for messages.

    User, password and query of a URL are removed, and so is its scheme, because a `Path` would turn `//` into `/`.
    """
    if isinstance(stream, int):
        return f"camera {stream}"
    return re.sub(r"^[a-z0-9+.-]+://(?:[^/@]*@)?", "", stream, flags=re.IGNORECASE).partition("?")[0]


def _open(stream: int | str):
    """Open the capture. Raises InputError if that fails."""
    import cv2

    if isinstance(stream, str) and Path(stream).is_file():
        raise InputError(f"{stream}: is a file (source.stream): give it as source.path")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when the first stream is opened
    with quiet_opencv():
        try:
            if isinstance(stream, int) or "://" not in stream:  # a camera, by number or device path
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
