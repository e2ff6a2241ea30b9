"""Prefetching: a thread reads the next frames while the mapper works on the current one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from queue import SimpleQueue
from threading import Semaphore, Thread
from typing import TypeVar

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame

__all__ = ["FramesAhead"]

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
        self._end: BaseException | None = None
        self._closed = False
        # A daemon thread, so that the process can exit even if this object was not closed. It only reads.
        self._thread = Thread(target=self._read, name="frames ahead", daemon=True) if ahead else None
        if self._thread is not None:
            self._thread.start()

    def __next__(self) -> Item:
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
