"""The listening socket (Unix or TCP), and the accepted connections that have not sent anything yet."""

from __future__ import annotations

import ipaddress
import selectors
import socket
import stat
import time
from collections.abc import Iterable
from pathlib import Path

from modp_ti.files.errors import InputError

DEFAULT_ADDRESS = "127.0.0.1:7007"
# Largest size of a Unix socket's path in bytes.
MAX_SOCKET_PATH = 107
# Backlog: connections that the system queues while the server reads from another one.
WAITING = 8
# Timeout [s] for the first byte of a connection.
HELLO_PATIENCE = 30.0
# Idle connections that are kept. If there are more, the oldest are closed.
MAX_SILENT = 16


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
    host, port = _parts(address or DEFAULT_ADDRESS)
    try:
        family, _, _, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
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
            f"tracker.address {address or DEFAULT_ADDRESS}: cannot listen there: {error.strerror}; "
            "take another port or end the program that has it"
        ) from None
    host, port = listener.getsockname()[:2]
    return listener, f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def open_to_others(listener: socket.socket) -> bool:
    """Whether other machines can reach the socket."""
    if listener.family == socket.AF_UNIX:
        return False
    return not ipaddress.ip_address(listener.getsockname()[0]).is_loopback


def _parts(address: str) -> tuple[str, int]:
    host, colon, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise InputError(f"tracker.address: write it as host:port, for example {DEFAULT_ADDRESS}, not {address}")
    return host, int(port)


def _at_path(path: Path) -> socket.socket:
    if len(str(path).encode()) > MAX_SOCKET_PATH:
        raise InputError(f"{path}: a Unix socket's path has at most {MAX_SOCKET_PATH} bytes (tracker.path)")
    _remove_left_over(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listener.bind(str(path))
        path.chmod(0o600)  # of this user alone
        listener.listen(WAITING)
    except OSError as error:
        listener.close()
        raise InputError(f"{path}: cannot listen there: {error.strerror} (tracker.path)") from None
    return listener


def _remove_left_over(path: Path) -> None:
    """Delete a stale socket. Raises InputError if a program listens there or the path is another kind of file."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return
    if not stat.S_ISSOCK(mode):
        raise InputError(f"{path}: is there already and no socket; tracker.path must name a new one")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            path.unlink(missing_ok=True)
            return
    raise InputError(f"{path}: another program listens there (tracker.path)")


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
        spoken = self._spoken(timeout)
        if spoken is None:
            self._drop(sock for sock, until in self._silent.items() if time.monotonic() > until)
        else:
            self._forget(spoken)
        return spoken

    def waits(self) -> bool:
        """Whether a connection has data to read or is at its end."""
        return self._spoken(0.0) is not None

    def take_back(self, sock: socket.socket, patience: float) -> None:
        """Keep a connection until it says more, for so many seconds."""
        self._silent[sock] = time.monotonic() + patience
        self._selector.register(sock, selectors.EVENT_READ, data=sock)

    def _spoken(self, timeout: float) -> socket.socket | None:
        """Accept connections for up to `timeout` seconds; return the first one with data to read or at its end."""
        spoken: socket.socket | None = None
        for key, _ in self._selector.select(timeout):
            if key.fileobj is self._listener:
                self._accept()
            elif spoken is None:
                spoken = key.data
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
        self.take_back(sock, self._patience)
        self._drop(list(self._silent)[:-MAX_SILENT])

    def _drop(self, sockets: Iterable[socket.socket]) -> None:
        for sock in list(sockets):
            self._forget(sock)
            sock.close()
            self.dropped += 1

    def _forget(self, sock: socket.socket) -> None:
        self._selector.unregister(sock)
        del self._silent[sock]
