"""A camera on the loopback: MJPEG over HTTP from a thread of this process, which sends what the test tells it to."""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from queue import SimpleQueue

import cv2
import numpy as np
from numpy.typing import NDArray


def encoded(image: NDArray[np.uint8]) -> bytes:
    """An image (H, W, 3) BGR as JPEG."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


class MjpegCamera:
    """send_jpeg: some frames; end: the stream."""

    def __init__(self) -> None:
        self._frames: SimpleQueue[bytes | None] = SimpleQueue()
        camera = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                while (data := camera._frames.get()) is not None:
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                    try:
                        self.wfile.write(head.encode() + data + b"\r\n")
                    except OSError:
                        return  # the client is gone

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self.url = f"http://user:secret@127.0.0.1:{self._server.server_address[1]}/stream.mjpg?quality=90"

    def send_jpeg(self, *frames: bytes) -> None:
        for data in frames:
            self._frames.put(data)

    def end(self) -> None:
        self._frames.put(None)

    def shut_down(self) -> None:
        self.end()
        self._server.shutdown()
        self._server.server_close()
