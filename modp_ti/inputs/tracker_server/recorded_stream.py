"""A stream as a `Spool` has kept it, which is sent again after its run was killed."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from modp_ti.inputs.tracker_server.messages import (
    FRAME,
    HEADER,
    MAGIC,
    Hello,
    Kind,
    ProtocolError,
    encoded,
    parse_header,
    parse_hello,
)

# Names in a spool's folder: the file of the messages, and the folder of the images, which FRAMEs have left out.
STREAM, FRAMES = "stream.modp", "frames"


def is_stream(path: Path | None) -> bool:
    """Whether the path is a file that begins as a stream does."""
    if path is None or not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def send_again(file: Path, address: tuple[str, int]) -> None:
    """Connect to a server and send the messages of a file, as far as they are whole."""
    with suppress(OSError), socket.create_connection(address) as sock:
        with suppress(ProtocolError, struct.error):
            for message in _messages(file):
                sock.sendall(message)
        sock.sendall(encoded(Kind.END, b""))
        while sock.recv(1024):  # until the server has read everything
            pass


def _messages(file: Path) -> Iterator[bytes]:
    hello: Hello | None = None
    with file.open("rb") as stream:
        while len(header := stream.read(HEADER.size)) == HEADER.size:
            kind, length = parse_header(header, hello)
            image = b""
            if kind is Kind.FRAME:
                start = stream.read(FRAME.size)
                number, *_, size = FRAME.unpack(start)
                assert hello is not None, "parse_header refuses others"
                if size > length - FRAME.size:
                    return
                try:
                    image = (file.parent / FRAMES / hello.encoding.file(number)).read_bytes()
                except OSError:  # it was refused
                    stream.seek(length - size - FRAME.size, 1)
                    continue
                payload = start + stream.read(length - size - FRAME.size) + image
            else:
                payload = stream.read(length)
            if len(payload) < length:
                return
            if kind is Kind.HELLO:
                hello = parse_hello(payload)
            yield header + payload
