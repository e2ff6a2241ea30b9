"""A peer that misbehaves, a program of its own with the standard library alone: `python misbehaving.py SOCKET HOW`."""

import socket
import struct
import sys
import time

HELLO = struct.pack("<IIII12d", 8, 6, 4, 0, 9.0, 9.5, 4.0, 3.0, *[0.0] * 8)
IDENTITY = [1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0]


def message(kind: int, payload: bytes = b"", length: int | None = None) -> bytes:
    return struct.pack("<4sHHII", b"MODP", 1, kind, len(payload) if length is None else length, 0) + payload


def frame(number: int, state: int = 1, x: float = 0.0) -> bytes:
    pose = [*IDENTITY[:3], x, *IDENTITY[4:]] if state == 1 else [0.0] * 16
    return struct.pack("<IId16dII", number, state, 0.1 * number, *pose, 0, 144) + bytes([number % 250]) * 144


def connected() -> socket.socket:
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    server.settimeout(1200.0)
    server.connect(sys.argv[1])
    return server


def answers(server: socket.socket) -> bytes:
    """Everything up to the end of the connection."""
    data = b""
    try:
        while part := server.recv(4096):
            data += part
    except OSError:
        pass
    return data


STARTS = {
    "too large": message(1, HELLO, length=2**32 - 1),
    "wrong order": message(2, frame(1)),
    "NaN": message(1, HELLO[:16] + struct.pack("<d", float("nan")) + HELLO[24:]),
    "no protocol": b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n",
    "half a message": message(1, HELLO)[:40],
    "nothing": b"",
    "an image too short": message(1, HELLO) + message(2, frame(1)[:-50], length=len(frame(1))),
}


def bad_starts(rounds: int = 3) -> None:
    for start in list(STARTS.values()) * rounds:
        with connected() as server:
            server.sendall(start)
            server.shutdown(socket.SHUT_WR)
            answers(server)


def silent() -> None:
    connections = [connected() for _ in range(8)]
    print("waiting", flush=True)
    sys.stdin.read()  # until the test is done
    for server in connections:
        server.close()


def endless(payload) -> None:
    """Sends without end and prints what the server says of it."""
    with connected() as server:
        server.sendall(message(1, HELLO) + message(2, frame(1)))
        try:
            for number in range(2, 100_000):
                server.sendall(payload(number))
        except OSError:
            pass
        print(answers(server)[-200:].decode(errors="replace"))


def trickle() -> None:
    with connected() as server:
        try:
            for byte in message(1, HELLO):
                server.sendall(bytes([byte]))
                time.sleep(0.2)
        except OSError:
            pass


{
    "bad starts": bad_starts,
    "silent": silent,
    "frames without poses": lambda: endless(lambda number: message(2, frame(number, state=0))),
    "corrections": lambda: endless(
        lambda number: message(4, struct.pack("<IIII16d", 1, 0, 1, 0, *IDENTITY[:3], number * 1e-3, *IDENTITY[4:]))
    ),
    "trickle": trickle,
}[sys.argv[2]]()
