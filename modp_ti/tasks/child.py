"""The process of a call of `LocalEngine`: receives the call, makes it, and sends its reports and its answer."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from multiprocessing.connection import Connection
from typing import Any

from modp_ti.files.ending_signals import left_to_parent
from modp_ti.files.terminal import own_terminal
from modp_ti.tasks.task import perform

__all__ = ["main"]

# Least time between two reports, each of which wakes the parent [s].
REPORT_EVERY = 0.5
# Time that the call gets to save what it has when the parent process is gone [s].
PATIENCE = 30.0


def main() -> None:
    """Serve the parent process; the argument is the descriptor of the pipe to it."""
    left_to_parent()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # by which `_listen` passes on that the parent stops
    own_terminal()
    connection = Connection(int(sys.argv[1]))
    try:
        work = connection.recv()
    except EOFError:
        return
    threading.Thread(target=_listen, args=[connection], name="parent", daemon=True).start()
    told = 0.0

    def report(content: Any) -> None:
        nonlocal told
        if time.monotonic() - told >= REPORT_EVERY:
            told = time.monotonic()
            _send(connection, content)

    answer = perform(work, report)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent closes the pipe once it has the answer
    sys.stderr.write(answer.traceback)
    _send(connection, answer)


def _send(connection: Connection, message: Any) -> None:
    try:
        connection.send(message)
    except OSError:
        pass  # the parent is gone, and `_listen` ends this process


def _listen(connection: Connection) -> None:
    """Interrupt the call, as Ctrl-C does, when the parent asks for it or is gone. If it is gone, end the process."""
    try:
        connection.recv()
        gone = False
    except (EOFError, OSError):
        gone = True
    os.kill(os.getpid(), signal.SIGINT)
    if gone:
        threading.Event().wait(PATIENCE)
        os._exit(1)
