"""Reading ahead: the next frames are made ready in a thread while the mapper works on the current one."""

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
    """The frames of `frames` in their order, up to `ahead` of them read and their pyramids built before they are due.

    Corrections of poses come in their places between them; one counts as a frame.

    One thread reads. Taichi's kernels hold Python's lock while they run; OpenCV and NumPy, which do nearly all of
    decoding, undistorting and resizing, give it up and so work beside them. An error of `frames` is raised at the frame
    that it befell, after all frames before it. With `ahead` 0 there is no thread.

    A context manager: leaving it ends the thread, once the frame that it is at is read.
    """

    def __init__(self, frames: Iterable[Item], ahead: int) -> None:
        self._frames = iter(frames)
        self._ready: SimpleQueue[Item | BaseException] = SimpleQueue()
        self._free = Semaphore(ahead)  # frames that may still be read ahead
        self._end: BaseException | None = None
        self._closed = False
        # A daemon, so that a process whose owner forgot to close ends all the same: it only reads.
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
                    _ = item.pyramid  # kept by the frame, for the mapper
            except BaseException as error:  # StopIteration too: whatever ends the frames comes after the last of them
                self._ready.put(error)
                return
            self._ready.put(item)
