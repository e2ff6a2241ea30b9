"""`TrackingProcess`: the tracker `klt` in a process of its own, and what is exchanged with it.

Frames without their pictures and corrections go through a pipe; counts are in shared memory. Both processes read the
images, each for itself.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from pathlib import Path
from typing import ClassVar

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.files.processes import RecordingInterrupt, child_environment, withheld
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.protocol import Event, LiveCounts, Progress, Tracker
from modp_ti.inputs.replay import pictures_again
from modp_ti.inputs.source_settings import Scene
from modp_ti.inputs.sources import FrameReader, Intrinsics, Picture, Undistorter
from modp_ti.inputs.sources.live import StoredFrames, kept_frames

# Time [s] that the process gets to end by itself.
PATIENCE = 2.0


@dataclass(frozen=True)
class Job:
    """To the child: what to track. A live source stores its frames in `folder`, which belongs to the parent."""

    config: Scene
    folder: Path | None


@dataclass(frozen=True)
class Preparing:
    """Progress while the tracker is opened, as for `Progress`."""

    what: str
    done: int
    total: int


@dataclass(frozen=True)
class Opened:
    """The tracker is open."""

    notes: list[str]
    scale: float
    intrinsics: Intrinsics


@dataclass(frozen=True)
class CameraRevised:
    """The correction that follows, and all frames after it, have another camera.

    Attributes:
        intrinsics: The camera of the stored images.
    """

    intrinsics: Intrinsics


@dataclass(frozen=True)
class Ended:
    """The stream has ended, by an error of the input or a failure of the tracker if one is given."""

    notes: list[str]
    unreadable: Mapping[str, UnreadableImageError]
    error: InputError | None = None
    failure: str | None = None


class CountsBoard(ctypes.Structure):
    """Numbers in shared memory, each of which is read and written at once, without locks.

    The child writes the counts of `LiveCounts`, the number of frames (-1 if it is unknown) and whether images still
    arrive; the parent, also in a signal handler, that it wants the recording to end.
    """

    arrived: int
    tracked: int
    thinned: int
    lost: int
    newest: float
    frame_count: int
    recording: bool
    finish: bool
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("arrived", "tracked", "thinned", "lost", "frame_count")),
        *(("newest", ctypes.c_double), ("recording", ctypes.c_bool), ("finish", ctypes.c_bool)),
    )

    @classmethod
    def of(cls, file: int) -> CountsBoard:
        """Return the numbers in a temporary file, of which both processes have a descriptor."""
        os.ftruncate(file, ctypes.sizeof(cls))
        return cls.from_buffer(mmap.mmap(file, ctypes.sizeof(cls)))


class TrackingProcess(Tracker):
    """The tracker `klt`, and the capture of its images, in a process of its own, so that mapping does not delay them.

    It delivers what the tracker there delivers. Frames wait there until they are taken, without their pictures, which
    this process reads. `pictures` therefore needs the other one no more.

    Ctrl-C ends the recording, if this object is made in the main thread; a later one, or one after the end of the
    stream, goes to the handler that was there before. If the process dies, the recording ends too, with a note. The
    process ends when this one does.

    The process opens the tracker while this one goes on. `notes`, `scale`, `undistorter` and the first frame wait until
    it has done so, and raise InputError if it cannot.

    Args:
        config: The scene; the tracker is `klt`.
        progress: Called while the tracker is opened and this process waits for it.
    """

    corrects: ClassVar[bool] = True

    def __init__(self, config: Scene, progress: Progress | None = None) -> None:
        self._config = config
        self._taken = 0  # frames
        self._unreadable: Mapping[str, UnreadableImageError] = {}
        self._ended = False
        self._kept = None
        if config.source.stream is not None:
            self._kept = tempfile.TemporaryDirectory(prefix="modp-ti-live-", ignore_cleanup_errors=True)
        self._connection, theirs = Pipe()
        with tempfile.TemporaryFile() as board, theirs:
            self._board = CountsBoard.of(board.fileno())
            self._process = _started([theirs.fileno(), board.fileno()])
        opening = ThreadPoolExecutor(1)  # meanwhile, as a video is decoded once to be opened
        self._reader = opening.submit(self._opened_images)
        opening.shutdown(wait=False)
        self._interrupt = RecordingInterrupt(self._interrupted)
        self._progress = progress
        self._notes: list[str] = []
        self._scale = 1.0
        self._undistorter: Undistorter | None = None  # None until the process has opened the tracker
        try:
            self._connection.send(Job(config, None if self._kept is None else Path(self._kept.name)))
        except OSError:
            pass  # the process is gone: the wait for its first message says so
        except BaseException:
            self.close()
            raise

    def _wait_until_open(self) -> None:
        """Wait until the process has opened the source and the tracker."""
        while self._undistorter is None:
            message = self._receive()
            if isinstance(message, Opened):
                self._notes = [*message.notes, _shared_cores(self._config)]
                self._scale = message.scale
                self._undistorter = message.intrinsics.undistorter(message.scale)
            if isinstance(message, Preparing) and self._progress is not None:
                self._progress(message.what, message.done, message.total)
            if isinstance(message, Ended):
                self.close()
                raise message.error or InputError(f"the tracker could not be opened: {message.failure}")

    @property
    def notes(self) -> list[str]:
        self._wait_until_open()
        return self._notes

    @property
    def kept(self) -> Mapping[str, Mapping[str, str | None]]:
        return {} if self._kept is None else kept_frames(Path(self._kept.name))

    @property
    def scale(self) -> float:
        self._wait_until_open()
        return self._scale

    @property
    def undistorter(self) -> Undistorter:
        self._wait_until_open()
        assert self._undistorter is not None
        return self._undistorter

    @property
    def frame_count(self) -> int | None:
        return None if self._board.frame_count < 0 else self._board.frame_count

    @property
    def unreadable(self) -> Mapping[str, UnreadableImageError]:
        """Damaged images that were skipped. They are known when the stream has ended."""
        return self._unreadable

    @property
    def live(self) -> LiveCounts | None:
        b = self._board
        waiting = max(0, b.tracked - self._taken)
        counts = LiveCounts(b.arrived, b.tracked, b.thinned, b.lost, waiting, b.newest)
        return counts if self._config.source.follows_clock else None

    def __iter__(self) -> Iterator[Event]:
        """Iterate once over frames and corrections as the tracker delivers them.

        Raises:
            InputError: If the tracker rejects its input, or the process ends before the first frame.
        """
        self._wait_until_open()
        while not self._ended:
            message = self._receive()
            if isinstance(message, dict):
                frame = TrackedFrame(**message, **vars(self._reader.result().read(message["name"], self.undistorter)))
                self._taken += 1
                yield frame
            elif isinstance(message, CameraRevised):
                self._undistorter = message.intrinsics.undistorter(self._scale)
            elif isinstance(message, PoseCorrection):
                yield message
            elif isinstance(message, Ended):
                self._end(message)

    def pictures(self, names: Sequence[str]) -> Iterator[tuple[str, Picture]]:
        return pictures_again(self._reader.result(), ((name, self.undistorter) for name in names))

    def _opened_images(self) -> FrameReader:
        """Open the images in this process."""
        if self._kept is not None:
            return FrameReader(StoredFrames(Path(self._kept.name)), self._config.source)
        return FrameReader(open_source(self._config.source.model_copy(update={"realtime": False})), self._config.source)

    def close(self) -> None:
        """End the recording and the process, and remove what was stored."""
        self._ended = True
        with suppress(OSError):
            self._connection.send(None)  # the process exits when it notices
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._connection.close()  # last, as another thread may read from it until the process has ended
        self._interrupt.give_back()
        if self._reader.done() and self._reader.exception() is None:
            self._reader.result().images.close()
        if self._kept is not None:
            self._kept.cleanup()

    # ---- messages --------------------------------------------------------------------------------------------

    def _receive(self) -> object:
        """Wait for the next message. The death of the process counts as an `Ended`."""
        try:
            return self._connection.recv()
        except (EOFError, OSError):
            return Ended([], {}, failure=f"the tracker process ended ({self._cause()})")

    def _cause(self) -> str:
        try:
            code = self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            return "it closed its pipe"
        return f"signal {-code}" if code < 0 else f"exit code {code}"

    def _end(self, message: Ended) -> None:
        self._ended = True
        self._unreadable = message.unreadable
        self._notes += [note for note in message.notes if note not in self._notes]
        if message.error is not None:
            raise message.error
        if message.failure is not None:
            if self._taken == 0:
                raise InputError(f"{message.failure} before it delivered a frame")
            frames = "the frame" if self._taken == 1 else f"the {self._taken} frames"
            self._notes.append(f"{message.failure}; the map is finished with {frames} before")

    def _interrupted(self) -> bool:
        """End the recording after Ctrl-C; return whether it was going on."""
        if self._ended or not self._board.recording:
            return False
        self._board.finish = True
        return True


def _started(descriptors: list[int]) -> subprocess.Popen[bytes]:
    """Start the child with these descriptors. Ctrl-C and the like do not reach it."""
    code = "from modp_ti.inputs.tracking_process.child import main; main()"
    with withheld():
        return subprocess.Popen(
            [sys.executable, "-c", code, *map(str, descriptors)],
            pass_fds=descriptors,
            env=child_environment(threads=1),  # the other cores are the mapper's
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )


def _shared_cores(config: Scene) -> str:
    threads = config.mapper_threads
    mapper = "a thread for each core" if threads is None else "1 thread" if threads == 1 else f"{threads} threads"
    return f"the tracker has a process of its own with one core, the mapper {mapper} (`threads`)"
