"""Prefetching: a thread reads the next frames while the mapper works on the current one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from queue import SimpleQueue
from threading import Semaphore, Thread
from typing import TypeVar

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame

Item = TypeVar("Item", bound=TrackedFrame | PoseCorrection)


class FramesAhead(Iterator[Item]):
    """Iterator over `frames` that reads up to `ahead` of them in advance and builds their image pyramids.

    The order is kept. Pose corrections stay in their places between the frames, and each counts as one frame.

    A single thread reads. Taichi's kernels hold the GIL while they run. OpenCV and NumPy, which do nearly all of the
    decoding, undistortion and resizing, release it and therefore run in parallel. An error of `frames` is raised in its
    place, after all earlier frames.

    Use it as a context manager: on exit, the thread ends after the frame that it is reading.

    Args:
        frames: Frames and corrections of a tracker.
        ahead: Number of frames to read in advance. With 0, no thread is used.
    """

    def __init__(self, frames: Iterable[Item], ahead: int) -> None:
        self._frames = iter(frames)
        self._ready: SimpleQueue[Item | BaseException] = SimpleQueue()
        self._free = Semaphore(ahead)  # number of frames that may still be read ahead
        self._held: Item | None = None  # the next one, taken from the queue already
        self._end: BaseException | None = None
        self._closed = False
        # A daemon thread, so that the process can exit even if this object was not closed. It only reads.
        self._thread = Thread(target=self._read, name="frames ahead", daemon=True) if ahead else None
        if self._thread is not None:
            self._thread.start()

    def __next__(self) -> Item:
        if self._held is not None:
            item, self._held = self._held, None
            return item
        if self._thread is None:
            return next(self._frames)
        if self._end is not None:
            raise self._end
        item = self._ready.get()
        if isinstance(item, BaseException):
            self._end = item
            raise item
        self._free.release()
        return item

    @property
    def waiting(self) -> int:
        """Number of frames and corrections that were read in advance. The end of `frames` counts as one."""
        return self._ready.qsize() + (self._held is not None)

    def ready(self) -> bool:
        """Return whether the next frame, the end or an error is there already, so that `next` does not wait.

        Without a thread, frames are read on demand, so that the next one counts as there.
        """
        return self._thread is None or self._end is not None or self.waiting > 0

    def peek(self) -> Item | None:
        """Return what comes next without taking it; None if it is not there yet, or is the end or an error."""
        if self._held is None and self._end is None and not self._ready.empty():
            item = self._ready.get()
            if isinstance(item, BaseException):
                self._end = item
            else:
                self._free.release()
                self._held = item
        return self._held

    def put_back(self, item: Item) -> None:
        """Make an item that was just taken the next one again."""
        self._held = item

    def __enter__(self) -> FramesAhead[Item]:
        return self

    def __exit__(self, *error: object) -> None:
        if self._thread is not None:
            self._closed = True
            self._free.release()
            self._thread.join()

    def _read(self) -> None:
        while True:
            self._free.acquire()
            if self._closed:
                return
            try:
                item = next(self._frames)
                if isinstance(item, TrackedFrame):
                    _ = item.pyramid  # cached in the frame, for the mapper
            except BaseException as error:  # includes StopIteration, so that the end comes after the last frame
                self._ready.put(error)
                return
            self._ready.put(item)
