"""One sender's connection: whole messages in, one line out."""

from __future__ import annotations

import socket
import time
from threading import Event

from modp_ti.inputs.tracker_server.messages import HEADER, Header, Hello, Kind, ProtocolError, encoded, parse_header

__all__ = ["GLANCE", "Connection", "SenderGoneError"]

# Seconds for the first message once it has begun: whoever stops in it must not keep a tracker out.
FIRST_PATIENCE = 5.0
# What is read and thrown away after an error, so that closing does not take our last line back from the sender.
DRAIN_SECONDS = 1.0
# Seconds after which a thread that waits looks whether it is still wanted.
GLANCE = 0.2
CHUNK = 1 << 20


class SenderGoneError(Exception):
    """The connection is over, or silent for too long. The text says how."""


class Connection:
    """Reads messages from a connected socket.

    patience: seconds in which each must be there as a whole. closed: set, by another thread, when no more is wanted.
    """

    def __init__(self, sock: socket.socket, patience: float, closed: Event) -> None:
        self._socket = sock
        self._patience = patience
        self._closed = closed
        self._reset = False

    def receive(self, hello: Hello | None) -> tuple[Header, bytes]:
        """The next message, whose header is judged before its payload is read.

        Raises ProtocolError for one that is malformed or begins beyond its bounds, SenderGoneError at the end.
        """
        patience = self._patience if hello else min(self._patience, FIRST_PATIENCE)
        deadline = time.monotonic() + patience
        header = parse_header(self._read(HEADER.size, deadline, patience, begun=False), hello)
        return header, self._read(header.length, deadline, patience, begun=True)

    def _read(self, size: int, deadline: float, patience: float, begun: bool) -> bytes:
        data = bytearray()
        while len(data) < size:
            if self._closed.is_set():
                raise SenderGoneError("is let go: the run is over")
            left = deadline - time.monotonic()
            try:
                self._socket.settimeout(min(max(left, 0.001), GLANCE))
                part = self._socket.recv(min(size - len(data), CHUNK))
            except TimeoutError:
                if left > 0:
                    continue
                where = "in mid-message" if begun or data else "without a message"
                raise SenderGoneError(f"was silent for {patience:g} s {where}") from None
            except ConnectionResetError:
                # Said once, by a sender that died with our WELCOME unread; what it had sent may still be there.
                if self._reset:
                    raise SenderGoneError("is gone: the connection was reset") from None
                self._reset = True
                continue
            except OSError as error:
                raise SenderGoneError(f"is gone: {error.strerror or error}") from None
            if not part:
                raise SenderGoneError("ended in mid-message" if begun or data else "ended without END")
            data += part
        return bytes(data)

    def say(self, kind: Kind, payload: bytes = b"") -> None:
        """Tell the sender something; it need not listen."""
        try:
            self._socket.settimeout(DRAIN_SECONDS)
            self._socket.sendall(encoded(kind, payload))
        except OSError:
            pass

    def refuse(self, reason: str | ProtocolError) -> None:
        """Tell the sender in one line why this is the end, and end it."""
        self.say(Kind.ERROR, " ".join(str(reason).split()).encode())
        deadline = time.monotonic() + DRAIN_SECONDS
        try:
            self._socket.shutdown(socket.SHUT_WR)
            while time.monotonic() < deadline and self._socket.recv(CHUNK):
                pass
        except OSError:
            pass
        self.close()

    def close(self) -> None:
        """End the connection."""
        self._socket.close()
