"""Processes of ours: the signals that end them, and the environment of those that we start.

The signals are Ctrl-C, SIGTERM (`kill`, `docker stop`, a time limit) and SIGHUP (a closed terminal).
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

ENDING = tuple(number for number in signal.Signals if number.name in ("SIGINT", "SIGTERM", "SIGHUP"))
# Time [s] after a signal within which a SIGHUP says nothing new: shell and system both send it, systemd after SIGTERM.
SAME_HANGUP = 2.0

_last: tuple[int, float] = (signal.SIGINT, 0.0)  # the last of the signals, and when it came [s]


def exit_code() -> int:
    """Exit code of a program that one of these signals has ended: 130 (Ctrl-C), 143 (SIGTERM) or 129 (SIGHUP)."""
    return 128 + _last[0]


class EndingSignals:
    """Calls a handler when one of the signals comes, until `give_back`. It has no effect outside the main thread.

    Signals that are ignored, such as SIGHUP under `nohup`, stay so.

    Args:
        handler: Called with the number of the signal; None to raise KeyboardInterrupt, as Python does on Ctrl-C.
        others: Whether to take signals too whose handler is not the default one.
    """

    def __init__(self, handler: Callable[[int], object] | None = None, others: bool = False) -> None:
        global _last
        _last = signal.SIGINT, 0.0
        self._before: dict[int, Any] = {}
        for number in ENDING if threading.current_thread() is threading.main_thread() else ():
            before = signal.getsignal(number)
            default = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
            if before in (default, _interrupt) or (others and before not in (signal.SIG_IGN, None)):
                self._before[number] = before
                signal.signal(number, _interrupt if handler is None else _calling(handler))

    def stop_at_once(self) -> None:
        """Let the next signal raise KeyboardInterrupt."""
        for number in self._before:
            signal.signal(number, _interrupt)

    def give_back(self) -> Callable[[int], None]:
        """Restore the handlers that were there before, and return a function that passes a signal on to its handler."""
        before = self._before
        if threading.current_thread() is threading.main_thread():
            self._before = {}
            for number, handler in before.items():
                signal.signal(number, handler)

        def pass_on(number: int) -> None:
            global _last
            if not callable(before[number]):
                raise KeyboardInterrupt
            _last = number, -SAME_HANGUP  # new to that handler too
            before[number](number, None)

        return pass_on


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


@contextmanager
def withheld() -> Iterator[None]:
    """Keep the signals from a process that is started inside this context, until it calls `left_to_parent`."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def left_to_parent() -> None:
    """Ignore the signals in this process, which may reach it and its parent: the parent decides what they mean."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)


def _calling(handler: Callable[[int], object]) -> Callable[[int, object], object]:
    return lambda number, _: handler(number) if _is_new(number) else None


def _interrupt(number: int, *_: object) -> None:
    if _is_new(number):
        raise KeyboardInterrupt


def _is_new(number: int) -> bool:
    """Take note of a signal. Returns whether it says anything new."""
    global _last
    (_, when), now = _last, time.monotonic()
    _last = number, now
    if number in (signal.SIGINT, signal.SIGTERM):
        return True
    _leave_closed_terminal()
    return now - when > SAME_HANGUP


def _leave_closed_terminal() -> None:
    """Discard what would be written to a terminal that is gone, since every attempt would raise an error."""
    poll, nowhere = select.poll(), os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        poll.register(descriptor, 0)
    for descriptor, what in poll.poll(0):
        if what & (select.POLLHUP | select.POLLERR):
            os.dup2(nowhere, descriptor)
    os.close(nowhere)


def child_environment(threads: int | None = None) -> dict[str, str]:
    """Return the environment variables for `python -c` in another process, which finds the same modules.

    Args:
        threads: Number of threads of the numerical libraries, None for their own choice.
    """
    places = os.pathsep.join(place or os.getcwd() for place in sys.path)
    libraries = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    limits = {} if threads is None else dict.fromkeys(libraries, str(threads))
    return {**os.environ, **limits, "PYTHONPATH": places, "PYTHONSAFEPATH": "1"}
