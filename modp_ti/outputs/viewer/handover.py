"""Data exchange between the mapping thread and the viewer's threads, where nothing queues up, and its limit of cost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, TypeVar

from numpy.typing import NDArray

# Mapping time [s] whose share can be saved up while nothing is shown.
SAVED_UP = 60.0
# Maximum number of browsers that get rendered pictures.
MAX_BROWSERS = 32
T = TypeVar("T")


class CostLimit:
    """A time budget that earns `share` of the elapsed time and pays for the viewer's work.

    Work may start while the balance is positive, and may overdraw it. The next work then waits until the balance is
    positive again. The total cost therefore exceeds `share` of the time by at most the last piece of work.

    Args:
        share: Fraction of the mapping time that the viewer may cost.
        clock: Returns the time [s].

    Attributes:
        cost: Total cost so far [s].
    """

    def __init__(self, share: float, clock: Callable[[], float] = time.perf_counter) -> None:
        self.share = share
        self.cost = 0.0
        self._clock = clock
        self._balance = 0.0
        self._seen = clock()

    def allows(self) -> bool:
        """Return whether work may start now."""
        self._earn()
        return self._balance > 0.0

    def charge(self, seconds: float) -> None:
        """Subtract a cost [s] from the balance."""
        self.cost += seconds
        self._balance -= seconds

    @contextmanager
    def measured(self) -> Iterator[None]:
        """Charge the wall time of this context."""
        started = self._clock()
        try:
            yield
        finally:
            self.charge(self._clock() - started)

    @contextmanager
    def suspended(self) -> Iterator[None]:
        """Earn nothing inside this context, since the mapper is paused."""
        self._earn()
        try:
            yield
        finally:
            self._seen = self._clock()

    def _earn(self) -> None:
        now = self._clock()
        self._balance = min(self._balance + self.share * (now - self._seen), self.share * SAVED_UP)
        self._seen = now


class ThreadClock:
    """CPU time [s] that a set of threads has taken since the last query.

    The threads must be alive when the clock is created. On systems without per-thread CPU clocks, the result is always
    0.
    """

    def __init__(self, threads: list[threading.Thread]) -> None:
        clock_of = getattr(time, "pthread_getcpuclockid", None)
        clocks = [] if clock_of is None else [clock_of(thread.ident) for thread in threads]
        self._last = {clock: time.clock_gettime(clock) for clock in clocks}

    def since_last(self) -> float:
        taken = 0.0
        for clock, before in list(self._last.items()):
            try:
                self._last[clock] = time.clock_gettime(clock)
                taken += self._last[clock] - before
            except OSError:  # the thread has ended
                del self._last[clock]
        return taken


class Latest(Generic[T]):
    """A slot for one value. A new value replaces one that has not been fetched, or is merged with it.

    Args:
        merge: Combines (newer value, waiting value) into the value that waits next.

    Attributes:
        closed: Whether `close` has been called.
    """

    def __init__(self, merge: Callable[[T, T], T] = lambda newer, waiting: newer) -> None:
        self._merge = merge
        self._value: T | None = None
        self.closed = False
        self._changed = threading.Condition()

    @property
    def waiting(self) -> T | None:
        """The value that has not been fetched yet, or None."""
        return self._value

    def put(self, value: T) -> None:
        """Store a value without waiting for a reader."""
        with self._changed:
            self._value = value if self._value is None else self._merge(value, self._value)
            self._changed.notify_all()

    def take(self, timeout: float | None = None) -> T | None:
        """Wait for a value and fetch it; None after `timeout` seconds (None for no limit) and after `close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._value is not None or self.closed, timeout)
            value, self._value = self._value, None
            return None if self.closed else value

    def close(self) -> None:
        """Release all waiting readers. From here on, `take` returns None."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()


class Gate:
    """Controls whether the mapping thread proceeds. While paused, it lets one frame or step through per request.

    Requests for a step do not add up while one is pending, so repeated clicks have no delayed effect.

    Attributes:
        paused: Whether the gate is closed, except for one frame or step.
        holder: Id of the browser that closed it; None if no browser did.
    """

    def __init__(self) -> None:
        self.paused = False
        self.holder: int | None = None
        self._step = False
        self._changed = threading.Condition()

    def pause(self, paused: bool, holder: int | None = None, step: bool = False) -> None:
        """Close or open the gate; with `step`, let one frame or step through before it is closed."""
        with self._changed:
            self.paused, self.holder, self._step = paused, holder, step
            self._changed.notify_all()

    def step(self, holder: int | None = None) -> None:
        """Let one frame or step through, then pause."""
        self.pause(True, holder, step=True)

    def wake(self) -> None:
        """Make a waiting `hold` call its `meanwhile` now."""
        with self._changed:
            self._changed.notify_all()

    def hold(self, meanwhile: Callable[[], None], every: float = 0.05) -> float:
        """Block while the gate is closed, calling `meanwhile` `every` so many seconds; return the time spent [s]."""
        started = time.perf_counter()
        while True:
            with self._changed:
                if not self.paused or self._step:
                    self._step = False
                    return time.perf_counter() - started
            meanwhile()
            with self._changed:
                if self.paused and not self._step:
                    self._changed.wait(every)


@dataclass(frozen=True)
class BrowserCamera:
    """A browser's camera, in the page's units and with OpenCV axes.

    Attributes:
        client: The browser's id.
        wxyz: Camera-to-world rotation as a quaternion (w, x, y, z).
        position: (3,) camera centre.
        fov: Vertical field of view [rad].
        width: Width of the canvas [px].
        height: Height of the canvas [px].
        mode: What the browser shows, one of `MODES`.
    """

    client: int
    wxyz: NDArray
    position: NDArray
    fov: float
    width: int
    height: int
    mode: str


class Requests:
    """The pictures that browsers need, with at most one pending request per browser.

    A browser needs a new picture when its camera has moved, its mode has changed, or the map has changed since its last
    one.
    """

    def __init__(self) -> None:
        self._cameras: dict[int, BrowserCamera] = {}
        self._due: list[int] = []  # ids of browsers with an outdated picture, longest waiting first
        self._changed = threading.Condition()

    def __len__(self) -> int:
        """Number of connected browsers."""
        return len(self._cameras)

    def __contains__(self, client: int) -> bool:
        """Whether this browser is connected."""
        return client in self._cameras

    def shows(self, mode: str) -> bool:
        """Return whether any browser shows this mode."""
        with self._changed:
            return any(camera.mode == mode for camera in self._cameras.values())

    def look(self, camera: BrowserCamera) -> None:
        """Register a browser or its new camera. Browsers beyond MAX_BROWSERS see the page but get no pictures."""
        with self._changed:
            if camera.client not in self._cameras and len(self._cameras) >= MAX_BROWSERS:
                return
            self._cameras[camera.client] = camera
            if camera.client not in self._due:
                self._due.append(camera.client)
            self._changed.notify_all()

    def leave(self, client: int) -> None:
        """Remove a browser that has disconnected."""
        with self._changed:
            self._cameras.pop(client, None)
            self._due = [other for other in self._due if other != client]
            self._changed.notify_all()

    def outdate(self) -> None:
        """Mark all pictures as outdated, after a change of the map."""
        with self._changed:
            self._due += [client for client in self._cameras if client not in self._due]
            self._changed.notify_all()

    def next(self, timeout: float = 0.0, but: str | None = None) -> BrowserCamera | None:
        """Return the camera of the browser that has waited longest; None if none waits in `timeout` seconds.

        Browsers in the mode `but` are left out.
        """

        def due() -> list[int]:
            return [client for client in self._due if self._cameras[client].mode != but]

        with self._changed:
            self._changed.wait_for(due, timeout)
            for client in due()[:1]:
                self._due.remove(client)
                return self._cameras[client]
        return None
