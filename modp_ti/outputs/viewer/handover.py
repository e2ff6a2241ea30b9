"""What passes between the mapping thread and those of the viewer: nothing queues up, and nobody waits for a browser."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from numpy.typing import NDArray

__all__ = ["BrowserCamera", "Gate", "Latest", "Requests"]

# Browsers that pictures are rendered for.
MAX_BROWSERS = 32

T = TypeVar("T")


class Latest(Generic[T]):
    """Room for one value: a newer one takes the place of one that nobody has fetched yet.

    merge: (newer, waiting) -> what waits then.
    """

    def __init__(self, merge: Callable[[T, T], T] = lambda newer, waiting: newer) -> None:
        self._merge = merge
        self._value: T | None = None
        self._closed = False
        self._changed = threading.Condition()

    @property
    def waiting(self) -> T | None:
        """What has not been fetched yet."""
        return self._value

    def put(self, value: T) -> None:
        """Leave a value; never waits."""
        with self._changed:
            self._value = value if self._value is None else self._merge(value, self._value)
            self._changed.notify_all()

    def take(self, timeout: float | None = None) -> T | None:
        """Fetch the value, waiting for one; None where none came in `timeout` seconds, and after `close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._value is not None or self._closed, timeout)
            value, self._value = self._value, None
            return None if self._closed else value

    @property
    def closed(self) -> bool:
        return self._closed

    def close(self) -> None:
        """Let those who wait go."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class Gate:
    """Lets the mapping thread through, holds it while paused, lets one frame or step through for each step asked for.

    A step that is asked for while another is under way is the same step: clicks do not pile up.
    """

    def __init__(self) -> None:
        self._paused = False
        self._step = False
        self._changed = threading.Condition()

    @property
    def paused(self) -> bool:
        return self._paused

    def pause(self, paused: bool) -> None:
        with self._changed:
            self._paused = paused
            self._step = False
            self._changed.notify_all()

    def step(self) -> None:
        """Let one through, and hold the next."""
        with self._changed:
            self._paused = self._step = True
            self._changed.notify_all()

    def wake(self) -> None:
        """Have whoever is held look around."""
        with self._changed:
            self._changed.notify_all()

    def hold(self, meanwhile: Callable[[], None], every: float = 0.05) -> float:
        """Return when the gate is open; the seconds that took. Meanwhile calls `meanwhile` every so many seconds."""
        started = time.perf_counter()
        while True:
            with self._changed:
                if not self._paused or self._step:
                    self._step = False
                    return time.perf_counter() - started
            meanwhile()
            with self._changed:
                if self._paused and not self._step:
                    self._changed.wait(every)


@dataclass(frozen=True)
class BrowserCamera:
    """Where a browser looks from, in the page's units: rotation camera to world (w, x, y, z) and centre.

    OpenCV axes. fov: vertical [rad]. width, height: of its canvas [px].
    """

    client: int
    wxyz: NDArray
    position: NDArray
    fov: float
    width: int
    height: int


class Requests:
    """What browsers ask for: the last word of each, no more than there are browsers.

    A picture is due where a browser has moved, or another mode was chosen, or the map has changed since its last one.
    """

    def __init__(self, mode: str) -> None:
        self._mode = mode
        self._cameras: dict[int, BrowserCamera] = {}
        self._due: list[int] = []  # browsers whose picture is out of date, the one that waits longest first
        self._changed = threading.Condition()

    @property
    def mode(self) -> str:
        return self._mode

    def __len__(self) -> int:
        """Browsers that are there."""
        return len(self._cameras)

    def look(self, camera: BrowserCamera) -> None:
        """A browser is there, or has moved. Beyond MAX_BROWSERS, further ones see the page and get no pictures."""
        with self._changed:
            if camera.client not in self._cameras and len(self._cameras) >= MAX_BROWSERS:
                return
            self._cameras[camera.client] = camera
            if camera.client not in self._due:
                self._due.append(camera.client)
            self._changed.notify_all()

    def leave(self, client: int) -> None:
        """A browser is gone."""
        with self._changed:
            self._cameras.pop(client, None)
            self._due = [other for other in self._due if other != client]
            self._changed.notify_all()

    def show(self, mode: str) -> None:
        """Another mode for all browsers."""
        with self._changed:
            self._mode = mode
        self.outdate()

    def outdate(self) -> None:
        """The map has changed."""
        with self._changed:
            self._due += [client for client in self._cameras if client not in self._due]
            self._changed.notify_all()

    def next(self, timeout: float = 0.0) -> BrowserCamera | None:
        """The camera of the browser that has waited longest for a picture; None where none does."""
        with self._changed:
            self._changed.wait_for(lambda: self._due, timeout)
            return self._cameras[self._due.pop(0)] if self._due else None
