"""A tracker that sends ten frames to a listening run (docs/tracker_server.md). It needs NumPy only."""

import socket
import struct
import sys

import numpy as np


def send(server: socket.socket, kind: int, payload: bytes = b"") -> None:
    """Send one message: its header and its payload."""
    server.sendall(struct.pack("<4sHHII", b"MODP", 1, kind, len(payload), 0) + payload)


server = socket.create_connection(("127.0.0.1", int(sys.argv[1]) if len(sys.argv) > 1 else 7007))
width, height, f = 64, 48, 60.0
send(server, 1, struct.pack("<IIII12d", width, height, 4, 0, f, f, width / 2, height / 2, *[0.0] * 8))

rng = np.random.default_rng(0)
world = np.c_[rng.uniform(-1, 1, (200, 2)), rng.uniform(3, 5, 200)]
for i in range(10):  # a camera that moves to the right before a cloud of points
    T_camera_world = np.eye(4)
    T_camera_world[0, 3] = -0.05 * i
    p = world + T_camera_world[:3, 3]
    pixels = f * p[:, :2] / p[:, 2:] + (width / 2, height / 2)
    image = np.full((height, width, 3), 40, np.uint8)
    seen = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    for x, y in pixels[seen].astype(int):
        image[y, x] = (250, 200, 100)
    points = b"".join(struct.pack("<q5d", n, *world[n], *pixels[n]) for n in np.flatnonzero(seen))
    head = struct.pack("<IId16dII", i, 1, i / 30, *T_camera_world.ravel(), seen.sum(), image.nbytes)
    send(server, 2, head + points + image.tobytes())
send(server, 5)
print(struct.unpack("<16sI", server.makefile("rb").read()[-20:])[1], "frames taken")
