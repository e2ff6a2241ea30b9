"""Accepted connections that have not sent anything yet. Idle connections do not block an active one."""

from __future__ import annotations

import selectors
import socket
import time
from collections import OrderedDict
from collections.abc import Callable

__all__ = ["HELLO_PATIENCE", "Lobby"]

# Timeout [s] for the first byte of a connection.
HELLO_PATIENCE = 30.0
# Idle connections that are kept. If there are more, the oldest are closed.
MAX_SILENT = 16


class Lobby:
    """Accepts connections and returns the first one that has sent data.

    Args:
        listener: The listening socket.
        patience: Timeout [s] for the first byte, at most `HELLO_PATIENCE`.

    Attributes:
        dropped: Number of connections that were closed because they sent nothing.
    """

    def __init__(self, listener: socket.socket, patience: float) -> None:
        self.dropped = 0
        self._listener = listener
        self._patience = min(patience, HELLO_PATIENCE)
        self._silent: OrderedDict[socket.socket, float] = OrderedDict()  # idle connections and their accept times
        self._selector = selectors.DefaultSelector()
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ)

    def next(self, timeout: float) -> socket.socket | None:
        """Return a connection with data to read or at its end, or None after `timeout` seconds without one."""
        self._send_away(lambda since: time.monotonic() - since > self._patience)
        spoken: socket.socket | None = None
        for key, _ in self._selector.select(timeout):
            if key.fileobj is self._listener:
                self._accept()
            elif spoken is None:
                spoken = key.data
        if spoken is not None:
            self._selector.unregister(spoken)
            del self._silent[spoken]
        return spoken

    def close(self) -> None:
        """Close all idle connections."""
        self._send_away(lambda since: True, counts=False)
        self._selector.close()

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError:  # the client has disconnected, or there are too many open files
            return
        self._silent[sock] = time.monotonic()
        self._selector.register(sock, selectors.EVENT_READ, data=sock)
        if len(self._silent) > MAX_SILENT:
            oldest = next(iter(self._silent.values()))
            self._send_away(lambda since: since <= oldest)

    def _send_away(self, whom: Callable[[float], bool], counts: bool = True) -> None:
        for sock in [sock for sock, since in self._silent.items() if whom(since)]:
            self._selector.unregister(sock)
            del self._silent[sock]
            sock.close()
            self.dropped += counts
