"""Who has connected and not said anything yet: nobody who keeps silent stands in the way of one who speaks."""

from __future__ import annotations

import selectors
import socket
import time
from collections import OrderedDict

__all__ = ["HELLO_PATIENCE", "Lobby"]

# Seconds for the first word.
HELLO_PATIENCE = 30.0
# Connections that may wait without one; of more, the oldest go.
MAX_SILENT = 16


class Lobby:
    """Accepts connections and hands out the first of them that has something to say.

    dropped: connections that went without a word, or were sent away for their silence.
    """

    def __init__(self, listener: socket.socket, patience: float) -> None:
        self.dropped = 0
        self._listener = listener
        self._patience = min(patience, HELLO_PATIENCE)
        self._silent: OrderedDict[socket.socket, float] = OrderedDict()  # since when
        self._selector = selectors.DefaultSelector()
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ)

    def next(self, timeout: float) -> socket.socket | None:
        """A connection from which there is something to read, its end at least; None where none came in that time."""
        self._send_away(lambda since: time.monotonic() - since > self._patience)
        spoken = None
        for key, _ in self._selector.select(timeout):
            if key.fileobj is self._listener:
                self._accept()
            elif spoken is None:
                spoken = key.fileobj
        if spoken is not None:
            self._selector.unregister(spoken)
            del self._silent[spoken]
        return spoken

    def close(self) -> None:
        """Send all away who wait."""
        self._send_away(lambda since: True, counts=False)
        self._selector.close()

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError:  # it went before it was let in, or there are too many open files
            return
        self._silent[sock] = time.monotonic()
        self._selector.register(sock, selectors.EVENT_READ)
        if len(self._silent) > MAX_SILENT:
            oldest = next(iter(self._silent.values()))
            self._send_away(lambda since: since <= oldest)

    def _send_away(self, whom, counts: bool = True) -> None:
        for sock in [sock for sock, since in self._silent.items() if whom(since)]:
            self._selector.unregister(sock)
            del self._silent[sock]
            sock.close()
            self.dropped += counts
