"""Ctrl-C: the first one asks a run to stop after the step that it is at, the second stops it at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["Interruption", "RunStopped"]


class RunStopped(Exception):  # noqa: N818 - it is no error
    """The user has asked for it, and the map stands between two steps."""


class Interruption:
    """A context in which the first Ctrl-C is only noted; after it Ctrl-C is what it was before.

    Where somebody else has taken Ctrl-C already, as a live source has, or it is ignored, it is left to them. asked:
    whether it was pressed. say: called when it was.
    """

    def __init__(self, say: Callable[[], None]) -> None:
        self.asked = False
        self._say = say
        self._waits = False
        self._installed = False

    def __enter__(self) -> Interruption:
        ours = threading.current_thread() is threading.main_thread()
        if ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._note)
            self._installed = True
        return self

    def __exit__(self, *error: object) -> None:
        self._give_back()

    def check(self) -> None:
        """Between two steps: raise RunStopped where Ctrl-C has been pressed."""
        if self.asked:
            raise RunStopped

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """While nothing is done to the map but waiting for the next frame, Ctrl-C raises RunStopped there and then."""
        self.check()
        self._waits = True
        try:
            yield
        finally:
            self._waits = False

    def _note(self, *_: object) -> None:
        self.asked = True
        self._give_back()
        if self._waits:
            raise RunStopped
        self._say()

    def _give_back(self) -> None:
        if self._installed:
            self._installed = False
            signal.signal(signal.SIGINT, signal.default_int_handler)
