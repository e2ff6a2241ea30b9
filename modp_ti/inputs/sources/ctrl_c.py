"""`RecordingInterrupt`: Ctrl-C ends a recording before it interrupts anything else."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType

__all__ = ["RecordingInterrupt"]


class RecordingInterrupt:
    """Handler of Ctrl-C while a live source records. It must be made in the main thread to have an effect.

    Ctrl-C gives the signal back to the handler that was there before. If the recording had ended already, that handler
    is called at once.

    Args:
        finish: Ends the recording; returns whether it was going on. It is called in the signal handler.
    """

    def __init__(self, finish: Callable[[], bool]) -> None:
        self._finish = finish
        self._before = None
        ours = threading.current_thread() is threading.main_thread()
        if ours and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            self._before = signal.signal(signal.SIGINT, self._pressed)

    def give_back(self) -> None:
        """Restore the handler that was there before."""
        if self._before is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, self._before)
            self._before = None

    def _pressed(self, number: int, frame: FrameType | None) -> None:
        before = self._before
        self.give_back()
        if self._finish():
            return
        if not callable(before):
            raise KeyboardInterrupt
        before(number, frame)
