"""Source `live`: a camera or a network stream, read with OpenCV as frames arrive.

`video_file` uses PyAV. Live sources use OpenCV because it finds cameras by number on every operating system.
"""

from __future__ import annotations

import atexit
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.runtime.process import has_room
from modp_ti.files.errors import InputError, shown_url
from modp_ti.files.processes import RecordingInterrupt
from modp_ti.inputs.sources.backlog import Arrivals, Backlog
from modp_ti.inputs.sources.image_header import DamagedImageError, read_image_header
from modp_ti.inputs.sources.image_pixels import decoded, quiet_opencv
from modp_ti.inputs.sources.protocol import ImageSource

# Memory [bytes] of decoded frames that wait for the tracker. Further ones wait on disk.
MEMORY = 64 << 20
# Timeout of a network stream [s], for opening it and for each frame.
PATIENCE = 10.0
# Time [s] without a frame from which on the end of a stream is told as a pause.
PAUSE = 1.0


class StoredFrames(ImageSource):
    """The frames of a live source in a folder, as PNG files. Frame n is called `live_<n, six digits>`.

    Args:
        folder: The folder, which exists.
        names: Names of the frames that are there, in order.
        path: What messages call the source; None for the folder.
    """

    def __init__(self, folder: Path, names: Sequence[str] = (), path: Path | None = None) -> None:
        super().__init__(folder if path is None else path, names, [0.0] * len(names))
        self.folder = folder

    def file(self, number: int) -> Path:
        """Place of the n-th delivered frame."""
        return self.folder / f"{number:06d}.png"

    def _write(self, file: Path, image: NDArray[np.uint8]) -> None:
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
            raise InputError(
                f"{self.folder}: frames of the live source cannot be kept there: {error.strerror}; "
                "make room, or set TMPDIR to a folder that has some"
            ) from None

    def read(self, name: str) -> NDArray[np.uint8]:
        """Read a delivered frame (H, W, 3) uint8 RGB.

        Raises:
            InputError: If the file is missing or damaged.
        """
        file = self.file(int(name.rpartition("_")[2]))
        image = decoded(file.read_bytes()) if file.is_file() else None
        if image is None:
            raise InputError(f"{file}: the frame that was kept there is gone or damaged: leave the folder alone")
        return image


@dataclass
class _Captured:
    """A frame (H, W, 3) BGR that waits for the tracker, in memory or in a file."""

    image: NDArray[np.uint8] | None
    file: Path


class LiveSource(StoredFrames):
    """A source that is still recording. The n-th delivered frame is called `live_<n, six digits>`.

    A thread captures frames continuously. They wait for `arriving` in a `Backlog`, which leaves frames out evenly if
    they arrive faster than they are taken; most of these are not decoded. Each delivered frame is stored without loss
    in a folder, from which `read` decodes it again. Times are those of arrival [s], on the Unix clock.

    The recording ends when the stream ends or sends nothing for `PATIENCE`, when `arriving` reaches its `stop`, when
    `finish` is called, if the disk is full, or on the first Ctrl-C if the source was opened in the main thread of a
    process that does not ignore Ctrl-C. A later Ctrl-C goes to the handler that was there before.

    Args:
        stream: Number of a camera, or URL.
        folder: Folder for the frames, which belongs to the caller. If it is None, `close` removes a temporary one.
        clock: Monotonic clock [s], by which frames arrive and the tracker's time is measured.

    Raises:
        InputError: If the stream cannot be opened or sends no frame.
    """

    def __init__(
        self, stream: int | str, folder: Path | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        if isinstance(stream, str) and stream.isdigit():
            stream = int(stream)
        self._kept = None
        if folder is None:
            self._kept = tempfile.TemporaryDirectory(prefix="modp-ti-live-", ignore_cleanup_errors=True)
            folder = Path(self._kept.name)
        super().__init__(folder, path=Path(_shown(stream)))
        self._backlog: Backlog[_Captured] = Backlog(self._drop)
        self._held = 0  # bytes of the images that wait in memory
        self._changed = threading.Condition()
        self._delivering = threading.Lock()
        self._ended = False
        self._end: str | None = None  # why the recording ended, if not on request
        self._last: tuple[str, NDArray[np.uint8]] | None = None
        self._received: list[float] = []
        self._capture = _open(stream)
        # The system clock may be adjusted during the recording, so times advance with the monotonic clock.
        self._clock, self._epoch = clock, time.time() - clock()
        first = self._grab()
        if first is None or first[1] is None:
            self._capture.release()
            raise InputError(f"{self.path}: sends no frame (source.stream); is it in use by another program?")
        self._size = (first[1].shape[1], first[1].shape[0])
        self._add(*first)
        # A daemon, so that a stalled stream does not keep the process alive. `close` is registered with atexit because
        # Python would otherwise kill the thread inside the decoder at shutdown.
        self._thread = threading.Thread(target=self._take, name=f"frames of {self.path}", daemon=True)
        self._thread.start()
        atexit.register(self.close)
        self._interrupt = RecordingInterrupt(self._interrupted)

    @property
    def notes(self) -> list[str]:
        notes = [
            f"{self.path} is mapped live: Ctrl-C ends the recording, and the map is finished with what came",
            *self._notes,
        ]
        notes += self.arrivals.notes(self.path)
        if self.ending is not None:
            notes.append(f"the recording ended: {self.ending}")
        return notes

    @property
    def ending(self) -> str | None:
        return self._end

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
        self._end_now()

    @property
    def recording(self) -> bool:
        return not self._ended

    @property
    def kept(self) -> dict[str, dict[str, str | None]]:
        return kept_frames(self.folder)

    @property
    def arrivals(self) -> Arrivals:
        return self._backlog.arrivals

    def arrived(self, name: str) -> float | None:
        return self._received[self._position[name]]

    def read(self, name: str) -> NDArray[np.uint8]:
        """Read a delivered frame (H, W, 3) uint8 RGB, exactly as it arrived.

        Raises:
            InputError: If the stored frame is missing or damaged.
        """
        import cv2

        last = self._last
        if last is not None and last[0] == name:
            return np.asarray(cv2.cvtColor(last[1], cv2.COLOR_BGR2RGB), dtype=np.uint8)
        return super().read(name)

    def finish(self) -> None:
        """End the recording. Frames that have arrived are still delivered."""
        self._end_now(forget=False)

    def _end_now(self, why: str | None = None, forget: bool = True) -> None:
        """End the recording, for a reason if it was not asked to, and forget the frames that wait."""
        with self._changed:
            self._end = why or self._end
            self._ended = True
            if forget:
                self._backlog.clear()
            self._changed.notify_all()

    def close(self) -> None:
        """End the recording and release the camera. A temporary folder is removed with the frames."""
        self._end_now()
        # If the stream has stalled, the thread ends after its own timeout. Nothing depends on it.
        self._thread.join(1.0)
        self._interrupt.give_back()
        self._last = None
        if self._kept is not None:
            self._kept.cleanup()
        atexit.unregister(self.close)

    # ---- the capturing thread --------------------------------------------------------------------------------

    def _grab(self) -> tuple[float, NDArray[np.uint8] | None] | None:
        """Capture the next frame (BGR, None if nobody wants it) with its time of arrival [s]; None at the end."""
        import cv2

        try:
            more = self._capture.grab()
            arrived = self._clock()
            with self._changed:
                wanted = self._backlog.wants()
            if more and not wanted:
                return arrived, None
            more, image = self._capture.retrieve() if more else (False, None)
        except cv2.error:
            return None
        return (arrived, np.asarray(image, dtype=np.uint8)) if more else None

    def _take(self) -> None:
        """Capture frames until the recording ends; runs in the thread."""
        while not self._ended:
            asked = time.monotonic()
            frame = self._grab()
            if self._ended:
                break
            try:
                if frame is None:
                    waited = time.monotonic() - asked
                    sent = f"sent nothing for {waited:.0f} s" if waited >= PAUSE else "sends no more frames"
                    self._end_now(f"{self.path} {sent}", forget=False)
                else:
                    self._add(*frame)
            except InputError as error:
                self._end_now(str(error), forget=False)
        self._capture.release()

    def _add(self, arrived: float, image: NDArray[np.uint8] | None) -> None:
        """Let a frame wait, on disk if there is no room in memory. Raises InputError if the disk is full."""
        captured = _Captured(image, self.folder / f"waiting-{self._backlog.arrivals.arrived:06d}.png")
        if image is not None and self._held + image.nbytes > MEMORY:
            self._write(captured.file, image)
            captured.image = None
        with self._changed:
            if self._ended:
                captured.file.unlink(missing_ok=True)
                return
            self._held += 0 if captured.image is None else captured.image.nbytes
            self._backlog.add(arrived, None if image is None else captured)
            self._changed.notify_all()

    def _drop(self, captured: _Captured) -> None:
        """Forget a frame that is left out."""
        if captured.image is None:
            captured.file.unlink(missing_ok=True)
        else:
            self._held -= captured.image.nbytes

    # ---- the tracker's thread --------------------------------------------------------------------------------

    def _delivered(self, position: int) -> bool:
        """Wait until the frame at `position` is delivered or the recording has ended; return whether it exists."""
        with self._delivering:
            while len(self._names) <= position:
                with self._changed:
                    while (taken := self._backlog.take(self._clock())) is None:
                        if self._ended:
                            return False
                        self._changed.wait()
                    arrived, captured = taken
                    self._held -= 0 if captured.image is None else captured.image.nbytes
                try:
                    self._keep(arrived, captured)
                except InputError as error:
                    if not self._names:
                        raise
                    self._end_now(str(error))
                    return False
            return True

    def _keep(self, arrived: float, captured: _Captured) -> None:
        """Store a frame under its number. Raises InputError if the disk is full."""
        number, time_taken = len(self._names), self._epoch + arrived
        name, file = f"live_{number:06d}", self.file(number)
        if captured.image is None:
            os.replace(captured.file, file)
        else:
            self._write(file, captured.image)
            self._last = name, captured.image  # the tracker reads it next, so it need not be decoded
        with suppress(OSError):  # on file systems that keep no such times
            os.utime(file, (time_taken, time_taken))  # for `list_frames`
        self._received.append(arrived)
        self._append(name, time_taken)

    def _interrupted(self) -> bool:
        """End the recording in a signal handler; return whether it was going on."""
        if self._ended:
            return False
        # In a separate thread, because the interrupted one may hold the lock.
        threading.Thread(target=self.finish, daemon=True).start()
        return True


def _shown(stream: int | str) -> str:
    """Return the stream's name for messages.

    User, password and query of a URL are removed, and so is its scheme, because a `Path` would turn `//` into `/`.
    """
    if isinstance(stream, int):
        return f"camera {stream}"
    return shown_url(stream).rpartition("://")[2]


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


def kept_frames(folder: Path) -> dict[str, dict[str, str | None]]:
    """Return the settings that read the delivered frames again, see `Tracker.kept`."""
    return {"source": {"stream": None, "path": str(folder), "kind": "tum_rgbd"}}


def list_frames(folder: Path) -> None:
    """Write the list that makes the folder of a killed process a recording. Raises OSError if it cannot be written."""
    lines = []
    for file in sorted(folder.glob("[0-9]*.png")):
        with suppress(DamagedImageError), file.open("rb") as image:  # the last one may be cut off
            read_image_header(image)
            lines.append(f"{file.stat().st_mtime_ns / 1e9!r} {file.name}\n")
    (folder / "rgb.txt").write_text("".join(lines), encoding="utf-8")
