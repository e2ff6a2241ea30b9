"""Ctrl-C, SIGTERM and SIGHUP: the first stops the mapping after its current step, the second immediately."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from modp_ti.files.processes import EndingSignals


class RunStopped(Exception):  # noqa: N818 - it is no error
    """The user pressed Ctrl-C, and the run stopped between two steps with a consistent map."""


class Interruption:
    """Context manager that records the first Ctrl-C after `begin`; the second one raises `KeyboardInterrupt`.

    SIGTERM and SIGHUP count as Ctrl-C. Before `begin` there is no map to save, and Ctrl-C raises `KeyboardInterrupt`
    as usual. A live source that is opened inside the context ends its recording at the first Ctrl-C, and passes a later
    one on to this handler.

    It does nothing outside the main thread, and with signals that already have another handler or are ignored.

    Args:
        say: Called when Ctrl-C is pressed while the run is not waiting for a frame.

    Attributes:
        asked: Whether Ctrl-C has been pressed.
    """

    def __init__(self, say: Callable[[], None]) -> None:
        self.asked = False
        self._say = say
        self._begun = False
        self._waits = False

    def __enter__(self) -> Interruption:
        self._signals = EndingSignals(self._note)
        return self

    def __exit__(self, *error: object) -> None:
        self._signals.give_back()

    def begin(self) -> None:
        """There is a map from now on, which Ctrl-C leaves consistent."""
        self._begun = True

    def check(self) -> None:
        """Raise `RunStopped` if Ctrl-C has been pressed. Call it between two steps."""
        if self.asked:
            raise RunStopped

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """While the run waits for the next frame, let Ctrl-C raise `RunStopped` immediately.

        The map is not being changed at that point, so there is no step to finish.
        """
        self.check()
        self._waits = True
        try:
            yield
        finally:
            self._waits = False

    def _note(self, *_: object) -> None:
        self._signals.stop_at_once()
        if not self._begun:
            raise KeyboardInterrupt
        self.asked = True
        if self._waits:
            raise RunStopped
        self._say()
