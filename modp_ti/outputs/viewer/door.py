"""`Door`: the server behind the viewer's page, which answers to nobody without the address that was printed.

viser serves everyone who reaches its port, whatever page asks, trusts every message, and opens a tunnel to the public
on request. All private use of viser stands in this file. `tests/modp_ti/outputs/viewer/test_door.py` fails where
another version of viser differs, and `Door` then refuses to serve.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import http
import ipaddress
import logging
import re
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any, ClassVar
from urllib.parse import urlsplit
from weakref import WeakValueDictionary

import msgspec
import numpy as np
import viser
import websockets
import websockets.asyncio.server
import websockets.datastructures
import websockets.exceptions
from viser import _messages
from viser.infra import _infra
from websockets.http11 import Request, Response

from modp_ti.files.errors import InputError

# Largest message of a browser [bytes]. Those of our page have some hundred.
LARGEST_MESSAGE = 16 << 10
# Least time between two messages of a browser [s]. More often, it is read later and not stored.
MESSAGE_EVERY = 2e-3
# Most connections at a time, with those that have not said yet what they want.
MOST_CONNECTIONS = 64
# Longest wait for a browser's part in the end of its connection [s].
CLOSING = 1.0
# Number of ports that are tried, from the wanted one on.
TRIED_PORTS = 1000
# Largest number of a camera, in page units and in pixels.
FARTHEST = 1e9
# The address is in no other page's reach: neither as the referrer, nor in a frame, nor in a cache.
HEADERS = {"Referrer-Policy": "no-referrer", "X-Frame-Options": "DENY", "Cache-Control": "no-store"}

# What a camera's message holds, beside its type.
CAMERA = [field.name for field in fields(_messages.ViewerCameraMessage)]


def _camera_fits(content: dict[str, Any]) -> bool:
    """Whether a browser can look from there."""
    msgspec.convert(content, _messages.ViewerCameraMessage)
    numbers = np.hstack([content[name] for name in CAMERA])
    sides = content["image_height"], content["image_width"]
    return len(content) == 1 + len(CAMERA) and bool((abs(numbers) <= FARTHEST).all()) and min(sides) >= 0


def _click_fits(content: dict[str, Any]) -> bool:
    """Whether a browser can have clicked there."""
    click = msgspec.convert(content, _messages.ScenePointerMessage)
    numbers = np.hstack([click.ray_origin, click.ray_direction, *click.screen_pos])  # pyright: ignore - or raises
    return click.event_type == "click" and bool((abs(numbers) <= FARTHEST).all()) and any(numbers[3:6])


def _update_fits(content: dict[str, Any], control: Any) -> bool:
    """Whether a control can have the value."""
    value = content["updates"]["value"]
    if len(content["updates"]) != 1 or isinstance(value, bool) != (type(control.value) is bool):
        return False
    if isinstance(control, viser.GuiSliderHandle):
        return isinstance(value, (int, float)) and control.min <= value <= control.max
    return not isinstance(control, viser.GuiDropdownHandle) or value in control.options


class _Connection(websockets.asyncio.server.ServerConnection):
    """A connection to a browser, which delivers only what the door accepts."""

    door: ClassVar[Door]

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        if len(self.door.connections) >= MOST_CONNECTIONS and isinstance(transport, asyncio.Transport):
            transport.abort()
        self.door.connections.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self.door.connections.discard(self)
        super().connection_lost(exc)

    async def recv(self, decode: bool | None = None) -> Any:
        while True:
            message = await super().recv(decode)
            await asyncio.sleep(MESSAGE_EVERY)
            try:
                if self.door.takes(message):
                    return message
            except Exception:  # msgspec's, and RecursionError
                await self.close(websockets.CloseCode.POLICY_VIOLATION)  # from here on, the line above raises


class Door:
    """Serves viser's page at an address that holds a secret, until `close`.

    Host and Origin must be those of the served address. What a browser sends is read only if it is of our page, and a
    message that is none of its kind ends that browser's connection.

    Args:
        host: Address to listen on.
        port: Port to listen on. If it is taken, the next free one is used; 0 picks any free port.
        title: Title of the page's panel.
        takes_clicks: Whether clicks into the scene are accepted.

    Attributes:
        server: viser's server.
        url: Address of the page.
        connections: The open connections.

    Raises:
        InputError: If no port can be opened at `host`, or this version of viser cannot be guarded.
    """

    _opening = threading.Lock()

    def __init__(self, host: str, port: int, title: str, takes_clicks: bool = False) -> None:
        self._host, self._socket = host, _listening(host, port)
        self.port = self._socket.getsockname()[1]
        self._token = secrets.token_urlsafe(24)
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{self.port}/{self._token}/"
        self.connections: set[_Connection] = set()
        self._controls: WeakValueDictionary[str, Any] = WeakValueDictionary()
        self._guarded, self._takes_clicks = False, takes_clicks
        parts = SimpleNamespace(
            asyncio=SimpleNamespace(server=SimpleNamespace(serve=self._serve)),
            datastructures=websockets.datastructures,
            exceptions=websockets.exceptions,
        )
        with Door._opening, silent():
            _infra.websockets = parts  # pyright: ignore - viser takes its server from here
            try:
                self.server = viser.ViserServer(host=host, port=self.port, label=title, verbose=False)
            finally:
                _infra.websockets = websockets  # pyright: ignore
        if not self._guarded:
            self.close()
            raise InputError(f"the viewer cannot guard its page with viser {viser.__version__}; install viser 1.1.1")
        for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
            self.server._websock_server.unregister_handler(message)

    @property
    def beyond_this_machine(self) -> bool:
        """Whether other machines can reach the page."""
        return not ipaddress.ip_address(self._socket.getsockname()[0].partition("%")[0]).is_loopback

    def admit(self, *controls: Any) -> None:
        """Accept new values of these controls. Those of others are passed over."""
        self._controls.update({control._impl.uuid: control for control in controls})

    def dismiss(self, client: int) -> None:
        """End the connection of a browser."""
        connection = self.server._websock_server._live_connections.get(client)
        if connection is not None:
            asyncio.run_coroutine_threadsafe(connection.close(1011), self.server._event_loop)

    def close(self) -> None:
        """Stop serving."""
        with silent():
            self.server.stop()

    def takes(self, message: bytes | str) -> bool:
        """Return whether a message is one of our page.

        Raises:
            Exception: If it is damaged or holds what its kind cannot hold.
        """
        if not isinstance(message, bytes):
            raise ValueError("text")
        content = msgspec.msgpack.decode(message, type=dict[str, Any])
        if content["type"] == "ViewerCameraMessage":
            fits = _camera_fits(content)
        elif content["type"] == "GuiUpdateMessage" and content["uuid"] in self._controls:
            fits = _update_fits(content, self._controls[content["uuid"]])
        elif content["type"] == "ScenePointerMessage" and self._takes_clicks:
            fits = _click_fits(content)
        else:  # none of our page: other pointers, forms, commands, uploads, the tunnel
            return False
        if not fits:
            raise ValueError("out of range")
        return True

    def _serve(self, handler: Callable[..., Awaitable[None]], host: str, port: int, **options: Any) -> Any:
        """Stand in for `websockets.asyncio.server.serve`, to which viser hands its handlers."""
        page: Callable[..., Response | None] = options["process_request"]

        def process(connection: Any, request: Request) -> Response | None:
            refused = self._refusal(request)
            if refused is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{refused}\n")
            path = request.path.removeprefix(f"/{self._token}")
            response = page(connection, replace(request, path=path))
            if response is not None:
                for name, value in HEADERS.items():
                    response.headers[name] = value
            return response

        logger = logging.getLogger("modp_ti.viewer")
        logger.disabled = True  # refused handshakes are no concern of the terminal
        self._guarded = True
        return websockets.asyncio.server.serve(
            handler,
            sock=self._socket,
            process_request=process,
            subprotocols=[websockets.Subprotocol(f"viser-v{viser.__version__}")],
            create_connection=type("_Connection", (_Connection,), {"door": self}),
            max_size=LARGEST_MESSAGE,
            compression=None,
            close_timeout=CLOSING,
            logger=logger,
        )

    def _refusal(self, request: Request) -> str | None:
        """Return why a request is refused, or None if it is not."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            return f"this page is served at port {self.port} of {self._host} (through SSH, take the same port)"
        if any(origin.lower() != f"http://{hosts[0].lower()}" for origin in origins):
            return "a page of another origin may not read this one"
        token = request.path.partition("?")[0].split("/")[1:2]
        if not token or not secrets.compare_digest(token[0].encode(errors="replace"), self._token.encode()):
            return "open the whole address that MODP-Ti printed"
        return None

    def _is_ours(self, host: str) -> bool:
        """Whether a request's Host is that of the served address, and no name that a stranger has made point to it."""
        try:
            given = urlsplit(f"//{host}")
            name, port = given.hostname or "", given.port or 80
        except ValueError:
            return False
        bound = self._socket.getsockname()[0]
        names = {self._host.lower(), bound}
        names |= {socket.gethostname().lower()} if self.beyond_this_machine else {"localhost", "127.0.0.1", "::1"}
        any_address = bound in ("0.0.0.0", "::") and re.fullmatch(r"[0-9.]+|[0-9a-f:]+", name)
        return port == self.port and (name in names or bool(any_address))


def _listening(host: str, port: int) -> socket.socket:
    """Listen at the first free port from `port` on; at any for 0."""
    ports = range(port, min(port + TRIED_PORTS, 1 << 16)) if port else [0]
    for candidate in ports:
        try:
            family = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)[0][0]
            return socket.create_server((host, candidate), family=family)
        except OSError as error:
            if error.errno in (errno.EADDRINUSE, errno.EACCES):
                continue
            raise InputError(
                f"view.host {host}: no address of this machine ({error.strerror}); 127.0.0.1 is for this machine "
                "alone, 0.0.0.0 for all that reach it"
            ) from None
    raise InputError(f"view.port {port}: no free port from this one to {ports[-1]}; choose a lower one, or 0 for any")


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Suppress viser's own messages on the terminal."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
