"""`PacedSource`: a recording that is played at the pace of its time stamps."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from threading import Event

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.sources.backlog import Arrivals, Backlog
from modp_ti.inputs.sources.orientation import Turn
from modp_ti.inputs.sources.protocol import ImageSource


class PacedSource(ImageSource):
    """A recorded source whose images arrive at the times of their time stamps, the first one at once.

    The clock starts when `arriving` is first asked for an image. Images that arrive faster than they are taken are left
    out evenly, see `Backlog`. If `arriving` is called again, it begins with the same images, without waiting; all calls
    must select the same images.

    Args:
        images: The recorded source, with its camera and scale.
        clock: Monotonic clock [s].
        wait: Waits so many seconds; None to wait until `finish` is called at most.
    """

    def __init__(
        self,
        images: ImageSource,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[float], object] | None = None,
    ) -> None:
        super().__init__(images.path, images.names, map(images.timestamp, images.names))
        self.intrinsics = images.intrinsics
        self.vignette = images.vignette
        self.T_device_camera = images.T_device_camera
        self.scale = images.scale
        self._images = images
        self._clock = clock
        self._finished = Event()
        self._wait = self._finished.wait if wait is None else wait
        self._backlog: Backlog[str] = Backlog()
        self._due: NDArray[np.float64] | None = None  # of all selected images, once the clock has started
        self._come = 0  # number of them that have arrived
        self._order: list[str] = []  # the delivered images
        self._received: dict[str, float] = {}  # their times of arrival [s]

    @property
    def notes(self) -> list[str]:
        said = f"{self.path} is played at the pace of its time stamps"
        return [*self._images.notes, *self._notes, said, *self.arrivals.notes(self.path)]

    def arriving(self, start: int, stop: int | None, step: int) -> Iterator[str]:
        names = self.selected(start, stop, step)
        position = 0
        while position < len(self._order) or self._next(names):
            yield self._order[position]
            position += 1

    def _next(self, names: Sequence[str]) -> bool:
        """Wait for the next image to be tracked and append it to the order. Returns whether there is one."""
        if self._due is None:
            times = np.array([self.timestamp(name) for name in names])
            self._due = self._clock() + np.maximum.accumulate(times - times[0])
        while True:
            now = self._clock()
            while self._come < len(names) and self._due[self._come] <= now and not self._finished.is_set():
                self._backlog.add(float(self._due[self._come]), names[self._come])
                self._come += 1
            taken = self._backlog.take(now)
            if taken is not None:
                self._received[taken[1]] = taken[0]
                self._order.append(taken[1])
                return True
            if self._come == len(names) or self._finished.is_set():
                return False
            self._wait(float(self._due[self._come]) - now)

    @property
    def recording(self) -> bool:
        more = self._due is None or self._come < len(self._due)
        return more and not self._finished.is_set()

    @property
    def arrivals(self) -> Arrivals:
        return self._backlog.arrivals

    def arrived(self, name: str) -> float | None:
        return self._received.get(name)

    def finish(self) -> None:
        self._finished.set()

    # ---- the recording ---------------------------------------------------------------------------------------

    def find(self, name: str) -> str | None:
        return self._images.find(name)

    def find_all(self, names: Sequence[str]) -> tuple[list[str | None], str | None]:
        return self._images.find_all(names)

    def size(self, name: str) -> tuple[int, int]:
        return self._images.size(name)

    def turn(self, name: str) -> Turn:
        return self._images.turn(name)

    def read(self, name: str) -> NDArray[np.uint8]:
        return self._images.read(name)

    def valid(self, name: str) -> NDArray[np.bool_] | None:
        return self._images.valid(name)

    def close(self) -> None:
        self.finish()
        self._images.close()
