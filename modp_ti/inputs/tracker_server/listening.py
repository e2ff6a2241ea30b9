"""The listening socket (Unix or TCP), its idle connections, and the one to the sender, which reads whole messages."""

from __future__ import annotations

import ipaddress
import selectors
import socket
import time
from collections.abc import Iterable
from pathlib import Path
from threading import Event

from modp_ti.files.errors import InputError
from modp_ti.inputs.tracker_server.messages import HEADER, Hello, Kind, ProtocolError, encoded, parse_header

DEFAULT_ADDRESS = "127.0.0.1:7007"
# Largest size of a Unix socket's path in bytes.
MAX_SOCKET_PATH = 107
# Backlog: connections that the system queues while the server reads from another one.
WAITING = 8
# Timeout [s] for the first byte of a connection.
HELLO_PATIENCE = 30.0
# Idle connections that are kept. If there are more, the oldest are closed.
MAX_SILENT = 16
# Timeout [s] for the first message after its first byte, so that a stalled client does not block a tracker.
FIRST_PATIENCE = 5.0
# Time [s] for which input is still read and discarded after an error. Closing a socket with unread input resets the
# connection, and the sender would lose the error message.
DRAIN_SECONDS = 1.0
# Interval [s] at which waiting threads check whether they should stop.
GLANCE = 0.2
CHUNK = 1 << 20


def listen(address: str | None, path: Path | None) -> tuple[socket.socket, str]:
    """Open a listening socket.

    Args:
        address: TCP address as "host:port"; None for `DEFAULT_ADDRESS`.
        path: Path of a Unix socket, which is used instead of `address` if it is given.

    Returns:
        The socket and its name: "host:port" or "unix:path".

    Raises:
        InputError: If the address or path is invalid, in use or not available.
    """
    if path is not None:
        return _at_path(path), f"unix:{path}"
    address = address or DEFAULT_ADDRESS
    host, colon, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise InputError(f"tracker.address: write it as host:port, for example {DEFAULT_ADDRESS}, not {address}")
    try:
        family, _, _, _, where = socket.getaddrinfo(host, int(port), type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[
            0
        ]
        listener = socket.socket(family, socket.SOCK_STREAM)
    except OSError as error:
        raise InputError(f"tracker.address {address}: no such address of this machine: {error.strerror}") from None
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(where)
        listener.listen(WAITING)
    except OSError as error:
        listener.close()
        raise InputError(
            f"tracker.address {address}: cannot listen there: {error.strerror}; "
            "take another port or end the program that has it"
        ) from None
    host, port = listener.getsockname()[:2]
    return listener, f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def open_to_others(listener: socket.socket) -> bool:
    """Whether other machines can reach the socket."""
    if listener.family == socket.AF_UNIX:
        return False
    return not ipaddress.ip_address(listener.getsockname()[0]).is_loopback


def _at_path(path: Path) -> socket.socket:
    """Listen at a path, where at most a socket is that nobody listens at any more."""
    if len(str(path).encode()) > MAX_SOCKET_PATH:
        raise InputError(f"{path}: a Unix socket's path has at most {MAX_SOCKET_PATH} bytes (tracker.path)")
    if path.exists() and not path.is_socket():
        raise InputError(f"{path}: is there already and no socket; tracker.path must name a new one")
    if path.is_socket():
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            if probe.connect_ex(str(path)) == 0:
                raise InputError(f"{path}: another program listens there (tracker.path)")
        path.unlink(missing_ok=True)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listener.bind(str(path))
        path.chmod(0o600)  # of this user alone
        listener.listen(WAITING)
    except OSError as error:
        listener.close()
        raise InputError(f"{path}: cannot listen there: {error.strerror} (tracker.path)") from None
    return listener


class Lobby:
    """Accepts connections and returns the first one that has sent data. Idle connections do not block an active one.

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
        self._silent: dict[socket.socket, float] = {}  # idle connections and the ends of their patience, oldest first
        self._selector = selectors.DefaultSelector()
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ)

    def next(self, timeout: float) -> socket.socket | None:
        """Return a connection with data to read or at its end, or None after `timeout` seconds without one."""
        spoken: socket.socket | None = None
        for key, _ in self._selector.select(timeout):
            if key.fileobj is self._listener:
                self._accept()
            elif spoken is None:
                spoken = key.data
        if spoken is None:
            self._drop(sock for sock, until in self._silent.items() if time.monotonic() > until)
        else:
            self._forget(spoken)
        return spoken

    def close(self) -> None:
        """Close all idle connections."""
        for sock in self._silent:
            sock.close()
        self._selector.close()

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError:  # the client has disconnected, or there are too many open files
            return
        self._silent[sock] = time.monotonic() + self._patience
        self._selector.register(sock, selectors.EVENT_READ, data=sock)
        self._drop(list(self._silent)[:-MAX_SILENT])

    def _drop(self, sockets: Iterable[socket.socket]) -> None:
        for sock in list(sockets):
            self._forget(sock)
            sock.close()
            self.dropped += 1

    def _forget(self, sock: socket.socket) -> None:
        self._selector.unregister(sock)
        del self._silent[sock]


class SenderGoneError(Exception):
    """The connection has ended or timed out. The text says how, in one line."""


class Connection:
    """Reads messages from a connected socket.

    Args:
        sock: The socket.
        patience: Timeout [s] for each whole message.
        closed: Set by another thread to stop reading.
    """

    def __init__(self, sock: socket.socket, patience: float, closed: Event) -> None:
        self._socket = sock
        self._patience = patience
        self._closed = closed
        self._reset = False

    def receive(self, hello: Hello | None) -> tuple[Kind, bytes]:
        """Read the next message. Its header is checked before the payload is read.

        Args:
            hello: The connection's HELLO; None before it.

        Returns:
            The message's kind and payload.

        Raises:
            ProtocolError: If the header is invalid.
            SenderGoneError: If the connection ends or times out.
        """
        patience = self._patience if hello else min(self._patience, FIRST_PATIENCE)
        deadline = time.monotonic() + patience
        kind, length = parse_header(self._read(HEADER.size, deadline, patience, False), hello)
        return kind, self._read(length, deadline, patience, True)

    def _read(self, size: int, deadline: float, patience: float, begun: bool) -> bytes:
        data = bytearray()
        while len(data) < size:
            if self._closed.is_set():
                raise SenderGoneError("the sender is let go: the run is over")
            left = deadline - time.monotonic()
            try:
                self._socket.settimeout(min(max(left, 0.001), GLANCE))
                part = self._socket.recv(min(size - len(data), CHUNK))
            except TimeoutError:
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
        return bytes(data)

    def say(self, kind: Kind, payload: bytes = b"") -> None:
        """Send a message. Errors are ignored, because the sender need not read replies."""
        try:
            self._socket.settimeout(DRAIN_SECONDS)
            self._socket.sendall(encoded(kind, payload))
        except OSError:
            pass

    def refuse(self, reason: str | ProtocolError) -> None:
        """Send the reason as a one-line ERROR and close the connection."""
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
        """Close the connection."""
        self._socket.close()
