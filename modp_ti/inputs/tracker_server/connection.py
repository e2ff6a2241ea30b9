"""The connection to one sender, which reads whole messages and sends short replies."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from threading import Event

from modp_ti.inputs.tracker_server.messages import HEADER, Hello, Kind, ProtocolError, encoded, parse_header

# Timeout [s] for the first message after its first byte, so that a stalled client does not block a tracker.
FIRST_PATIENCE = 5.0
# Time [s] for which input is still read and discarded after an error. Closing a socket with unread input resets the
# connection, and the sender would lose the error message.
DRAIN_SECONDS = 1.0
# Interval [s] at which waiting threads check whether they should stop.
GLANCE = 0.2
CHUNK = 1 << 20


class SenderGoneError(Exception):
    """The connection has ended or timed out. The text says how, in one line."""


class OthersSpeakError(Exception):
    """The sender is silent between two messages, and another one is not."""


class Connection:
    """Reads messages from a connected socket.

    Args:
        sock: The socket.
        patience: Timeout [s] for each whole message.
        closed: Set by another thread to stop reading.

    Attributes:
        socket: As the argument.
        hello: Payload of the HELLO, kept by the caller.
    """

    def __init__(self, sock: socket.socket, patience: float, closed: Event) -> None:
        self.socket = sock
        self.hello: bytes | None = None
        self._patience = patience
        self._closed = closed
        self._reset = False

    def receive(self, hello: Hello | None, others: Callable[[], bool] = lambda: False) -> tuple[Kind, bytes]:
        """Read the next message. Its header is checked before the payload is read.

        Args:
            hello: The connection's HELLO; None before it.
            others: Returns whether another sender waits with something to say.

        Returns:
            The message's kind and payload.

        Raises:
            ProtocolError: If the header is invalid.
            SenderGoneError: If the connection ends or times out.
            OthersSpeakError: If `others` does, and this sender is silent.
        """
        patience = self._patience if hello else min(self._patience, FIRST_PATIENCE)
        deadline = time.monotonic() + patience
        kind, length = parse_header(self._read(HEADER.size, deadline, patience, False, others), hello)
        return kind, self._read(length, deadline, patience, True, others)

    def _read(self, size: int, deadline: float, patience: float, begun: bool, others: Callable[[], bool]) -> bytes:
        data, heard = bytearray(), time.monotonic()
        while len(data) < size:
            if self._closed.is_set():
                raise SenderGoneError("the sender is let go: the run is over")
            left = deadline - time.monotonic()
            try:
                self.socket.settimeout(min(max(left, 0.001), GLANCE))
                part = self.socket.recv(min(size - len(data), CHUNK))
            except TimeoutError:
                if left > 0 and others():
                    if not begun and not data:
                        raise OthersSpeakError from None
                    if time.monotonic() - heard > FIRST_PATIENCE:
                        left, patience = 0.0, FIRST_PATIENCE
                if left > 0:
                    continue
                where = "in mid-message" if begun or data else "without a message"
                raise SenderGoneError(f"the sender was silent for {patience:g} s {where}") from None
            except ConnectionResetError:
                # A sender that exits without reading WELCOME causes one reset. What it sent may still be readable.
                if self._reset:
                    raise SenderGoneError("the sender is gone: the connection was reset") from None
                self._reset = True
                continue
            except OSError as error:
                raise SenderGoneError(f"the sender is gone: {error.strerror or error}") from None
            if not part:
                raise SenderGoneError(
                    "the sender ended in mid-message" if begun or data else "the sender ended without END"
                )
            data += part
            heard = time.monotonic()
        return bytes(data)

    def say(self, kind: Kind, payload: bytes = b"") -> None:
        """Send a message. Errors are ignored, because the sender need not read replies."""
        try:
            self.socket.settimeout(DRAIN_SECONDS)
            self.socket.sendall(encoded(kind, payload))
        except OSError:
            pass

    def refuse(self, reason: str | ProtocolError) -> None:
        """Send the reason as a one-line ERROR and close the connection."""
        self.say(Kind.ERROR, " ".join(str(reason).split()).encode())
        deadline = time.monotonic() + DRAIN_SECONDS
        try:
            self.socket.shutdown(socket.SHUT_WR)
            while time.monotonic() < deadline and self.socket.recv(CHUNK):
                pass
        except OSError:
            pass
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self.socket.close()
