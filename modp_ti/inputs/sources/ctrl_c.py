"""`RecordingInterrupt`: Ctrl-C ends a recording before it interrupts anything else."""

from __future__ import annotations

from collections.abc import Callable

from modp_ti.files.ending_signals import EndingSignals

__all__ = ["RecordingInterrupt"]


class RecordingInterrupt:
    """Handler of Ctrl-C, SIGTERM and SIGHUP while a live source records. It must be made in the main thread.

    The first of them gives the signals back to the handlers that were there before. If the recording had ended already,
    that handler is called at once.

    Args:
        finish: Ends the recording; returns whether it was going on. It is called in the signal handler.
    """

    def __init__(self, finish: Callable[[], bool]) -> None:
        self._finish = finish
        self._signals = EndingSignals(self._pressed, others=True)

    def give_back(self) -> None:
        """Restore the handlers that were there before."""
        self._signals.give_back()

    def _pressed(self, number: int) -> None:
        pass_on = self._signals.give_back()
        if not self._finish():
            pass_on(number)
